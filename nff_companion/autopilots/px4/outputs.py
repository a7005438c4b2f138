"""Do PX4's outputs mean what the airframe file says? Motor order, thrust curve, pulse widths, protocol."""

from __future__ import annotations

from collections.abc import Mapping

from nff_companion.core.vehicle import Vehicle

_MOTOR_FUNCTION = 100  # PWM_MAIN_FUNCn of motor n, less n
_GROUPS = 4
_CURVE_TOLERANCE = 0.02
_WIDTH_TOLERANCE_US = 0.5


def names(vehicle: Vehicle) -> list[str]:
    """Parameters that are looked at; boards lack some of them."""
    motors = range(1, vehicle.motors + 1)
    per_motor = [f"PWM_MAIN_{what}{i}" for what in ("FUNC", "MIN", "MAX") for i in motors]
    return [*per_motor, *(f"PWM_MAIN_TIM{k}" for k in range(_GROUPS))]


def contradiction(values: Mapping[str, float], vehicle: Vehicle) -> str:
    """The first thing that would make the companion misread motor outputs; empty when nothing does."""
    curve = values.get("THR_MDL_FAC")
    if curve is not None and abs(curve - vehicle.command.thrust_expo) > _CURVE_TOLERANCE:
        return f"THR_MDL_FAC is {curve:g}, thrust_expo of the airframe file {vehicle.command.thrust_expo:g}"
    for motor in range(1, vehicle.motors + 1):
        function = values.get(f"PWM_MAIN_FUNC{motor}")
        if function is not None and function != _MOTOR_FUNCTION + motor:
            return f"PWM_MAIN_FUNC{motor} is {function:.0f}, motor {motor} needs {_MOTOR_FUNCTION + motor}"
        for what, wanted in (("MIN", vehicle.command.pwm_min), ("MAX", vehicle.command.pwm_max)):
            width = values.get(f"PWM_MAIN_{what}{motor}")
            if width is not None and abs(width - wanted) > _WIDTH_TOLERANCE_US:
                return f"PWM_MAIN_{what}{motor} is {width:.0f}, the airframe file says {wanted:.0f}"
    for group in range(_GROUPS):
        if values.get(f"PWM_MAIN_TIM{group}", 0.0) < 0.0:
            return f"PWM_MAIN_TIM{group}: outputs of DShot are in units that are not understood here yet"
    return ""


def conflict(values: Mapping[str, float], found: Mapping[str, float], *, injecting: bool) -> str:
    """Why telling PX4 its thrust coefficients would do nothing, or worse; empty when it works."""
    lost = next((name for name, value in found.items() if name.endswith("_CT") and value <= 0.0), None)
    if lost is not None:
        return f"{lost} is {found[lost]:g}: a motor without thrust; was a journal lost? Set it right first"
    if not injecting and values.get("CA_FAILURE_MODE", 0.0) > 0.0 and values.get("FD_ACT_EN", 0.0) > 0.0:
        return "PX4 handles failures itself (CA_FAILURE_MODE, FD_ACT_EN), and then ignores what it is told: use inject"
    return ""
