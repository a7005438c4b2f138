"""Which settings of the companion a ground station can see and change, by MAVLink's parameter protocol."""

from __future__ import annotations

from collections.abc import Callable

from nff_companion.companion_state import Orders
from nff_companion.condition import Mode
from nff_companion.core.tuning import Tuning
from nff_companion.mavlink.services.parameter_server import Parameter

_THRESHOLDS = {
    "NFF_IMPROVEMENT": ("improvement_min", 8.0, 200.0),
    "NFF_MARGIN": ("margin_min", 2.0, 100.0),
    "NFF_EXPLAINED": ("explained_min", 0.5, 0.99),
    "NFF_LOSS_SUDDEN": ("loss_sudden", 0.3, 0.95),
    "NFF_LOSS_SLOW": ("loss_gradual", 0.3, 0.95),
}


def settings(
    motors: int,
    mode: Callable[[], Mode],
    obey: Callable[[Orders], None],
    tuning: Callable[[], Tuning],
    retune: Callable[[Tuning], bool],
) -> list[Parameter]:
    """Mode, lift and thresholds of one companion. ``retune`` returns False where nothing may change now."""

    def set_mode(value: float) -> bool:
        obey(Orders(mode=Mode(int(value))))
        return True

    def lift(value: float) -> bool:
        if value >= 1:
            obey(Orders(lift=(int(value),)))
        return True

    def threshold(name: str, low: float, high: float, *, whole: bool = False) -> tuple[float, float, object, object]:
        def get() -> float:
            return float(getattr(tuning().decision, name))

        def change(value: float) -> bool:
            return retune(tuning().having("decision", **{name: int(value) if whole else value}))

        return low, high, get, change

    return [
        Parameter("NFF_MODE", 0, 2, lambda: float(mode()), set_mode, whole=True),
        Parameter("NFF_LIFT", 0, motors, lambda: 0.0, lift, whole=True),
        *(Parameter(name, *threshold(*where)) for name, where in _THRESHOLDS.items()),  # type: ignore[arg-type]
        Parameter("NFF_FAILED_MAX", *threshold("failed_max", 1, motors // 2, whole=True), whole=True),  # type: ignore[arg-type]
    ]
