"""Paired figures of flights with and without the companion."""

from __future__ import annotations

import numpy as np


def rms_ratio(companion: list[float], baseline: list[float]) -> dict[str, float] | None:
    """Tracking error with the companion over that without, with a 95 % interval by bootstrap over the flights."""
    if len(companion) != len(baseline) or not baseline or min(baseline) <= 0.0:
        return None
    with_it, without = np.array(companion), np.array(baseline)
    draw = np.random.default_rng(1).integers(len(without), size=(4000, len(without)))
    ratios = np.sqrt((with_it[draw] ** 2).mean(axis=1) / (without[draw] ** 2).mean(axis=1))
    low, high = np.percentile(ratios, [2.5, 97.5])
    value = np.sqrt((with_it**2).mean() / (without**2).mean())
    return {"ratio": round(float(value), 4), "low": round(float(low), 4), "high": round(float(high), 4)}
