"""What the estimator might have handed out: of a hover in which nothing is left over."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.estimate import Estimate
from nff_companion.core.vehicle import Vehicle


def hovering(vehicle: Vehicle, effectiveness: NDArray[np.float64] | None = None, **others: Any) -> Estimate:
    """``effectiveness`` (m,) None: all whole; ``failed``: indices of motors that are declared, none by default; of what
    else an estimate holds what is given."""
    failed = np.isin(np.arange(vehicle.motors), others.pop("failed", ()))
    nothing = np.zeros(vehicle.axes)
    values: dict[str, Any] = {
        "effectiveness": np.where(failed, 0.0, 1.0) if effectiveness is None else effectiveness,
        "deviation": np.full(vehicle.motors, 0.02),
        "failed": failed,
        "raw": nothing,
        "residual": nothing,
        "disturbance": nothing,
        "features": None,
        "thrust_shown": np.full(vehicle.motors, vehicle.hover),
        "lateral_m_s2": np.zeros(2),
        "best": None,
        "events": [],
    }
    return Estimate(**values | others)
