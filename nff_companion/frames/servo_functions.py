"""SERVOn_FUNCTION of ArduPilot's motors (libraries/SRV_Channel, SRV_Channel::Function)."""

from __future__ import annotations

SERVOS = 32
_FIRST_FUNCTION, _NINTH_FUNCTION = 33, 82


def function_of(motor: int) -> int:
    """SERVOn_FUNCTION of a motor (from 1)."""
    return _FIRST_FUNCTION + motor - 1 if motor <= 8 else _NINTH_FUNCTION + motor - 9
