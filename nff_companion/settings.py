"""Which settings of the companion a ground station can see and change: the mode, a lift, and served thresholds."""

from __future__ import annotations

from collections.abc import Callable

from nff_companion.companion_state import Orders
from nff_companion.condition import Mode
from nff_companion.core.tuning import Tuning, check
from nff_companion.core.tuning.parameters import SERVED, Served
from nff_companion.errors import ConfigError
from nff_companion.mavlink.services.parameter_server import Parameter


def settings(
    motors: int,
    mode: Callable[[], Mode],
    obey: Callable[[Orders], None],
    tuning: Callable[[], Tuning],
    retune: Callable[[Tuning], bool],
) -> list[Parameter]:
    """In the order of their indices. ``retune`` returns False where nothing may change now."""

    def set_mode(value: float) -> bool:
        obey(Orders(mode=Mode(int(value))))
        return True

    def lift(value: float) -> bool:
        if value >= 1:
            obey(Orders(lift=(int(value),)))
        return True

    return [
        Parameter("NFF_MODE", 0, max(Mode), lambda: float(mode()), set_mode, whole=True),
        Parameter("NFF_LIFT", 0, motors, lambda: 0.0, lift, whole=True),
        *(_threshold(served, motors, tuning, retune) for served in SERVED),
    ]


def _threshold(
    served: Served, motors: int, tuning: Callable[[], Tuning], retune: Callable[[Tuning], bool]
) -> Parameter:
    field = served.field
    subject, name = field.path[-2], field.path[-1]
    whole = field.kind is int

    def get() -> float:
        return float(getattr(getattr(tuning(), subject), name))

    def change(value: float) -> bool:
        wanted = tuning().having(subject, **{name: int(value) if whole else value})
        try:
            check(wanted)
        except ConfigError:
            return False  # in range for itself, but at odds with another threshold
        return retune(wanted)

    # More than half of the motors cannot be done without on any airframe.
    high = min(field.high, motors // 2) if name == "failed_max" else field.high
    return Parameter(served.name, field.low, high, get, change, whole)
