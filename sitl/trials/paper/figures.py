"""Figures of merit with 95 % intervals by bootstrap over the seeds; every controller has the same seeds.

A crash counts as 90 degrees, and as the height flown for as long as the vehicle lies there: no controller gains by it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sitl.trials.paper.scenario import AFTER_S, GROUPS, HEIGHT_M, WINDOW_S, Trace

AXES = ("roll", "pitch", "yaw")
CRASH_DEG = 90.0
_DRAWS = 4000
_STEP_S = 0.01  # of curves that are averaged over seeds


def attitude_curve_deg(trace: Trace) -> NDArray[np.float64]:
    """Size of the attitude error (L, 3) in the window after the failure, on a grid common to all flights. Moments at
    which the law did not close the loop have no error; a flight without any counts as crashed."""
    at = np.arange(0.0, WINDOW_S, _STEP_S)
    known = np.isfinite(trace.attitude_error_deg).all(axis=1)
    if not (known & (trace.time_s >= 0.0)).any():
        return np.full((len(at), 3), CRASH_DEG)
    time_s, error = trace.time_s[known], np.abs(trace.attitude_error_deg[known])
    curve = np.stack([np.interp(at, time_s, error[:, k]) for k in range(3)], axis=1)
    if trace.crashed:
        curve[at > trace.time_s[-1]] = CRASH_DEG
    return curve


def peak_deg(trace: Trace) -> NDArray[np.float64]:
    """Largest attitude error (3,) in the window after the failure; of a flight that crashed later too."""
    inside = (trace.time_s >= 0.0) & (trace.time_s <= WINDOW_S) & np.isfinite(trace.attitude_error_deg).all(axis=1)
    if trace.crashed or not inside.any():
        return np.full(3, CRASH_DEG)
    return np.asarray(np.abs(trace.attitude_error_deg[inside]).max(axis=0))


def mean_position_error_m(trace: Trace) -> float:
    """Over AFTER_S from the failure."""
    error = trace.position_error_m[trace.time_s >= 0.0]
    if not trace.crashed:
        return float(error.mean())
    if len(error) == 0:
        return HEIGHT_M
    flown = float(trace.time_s[-1]) / AFTER_S
    return flown * float(error.mean()) + (1.0 - flown) * max(float(error[-1]), HEIGHT_M)


def false_loss(trace: Trace) -> float:
    """Largest loss that was believed of a motor that works, after the failure."""
    working = np.arange(1, trace.effectiveness.shape[1] + 1) != trace.case.motor
    believed = trace.effectiveness[trace.time_s >= 0.0][:, working]
    return float(np.clip(1.0 - believed, 0.0, 1.0).max()) if believed.size else 1.0


def position_error_before_m(trace: Trace) -> float:
    """Over BEFORE_S until the failure: what the controller does without one."""
    error = trace.position_error_m[trace.time_s < 0.0]
    return float(error.mean()) if len(error) else HEIGHT_M


class Bootstrap:
    """Draws of the seeds, the same for every figure and controller."""

    def __init__(self, seeds: int) -> None:
        self._draw = np.random.default_rng(1).integers(seeds, size=(_DRAWS, seeds))
        self._share = np.stack([np.bincount(row, minlength=seeds) for row in self._draw]) / seeds

    def means(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Means (draws, ...) of ``values`` (seeds, ...)."""
        flat = values.reshape(len(values), -1)
        return (self._share @ flat).reshape(_DRAWS, *values.shape[1:])


def interval(values: NDArray[np.float64]) -> list[float]:
    """95 % of the drawn ``values``."""
    low, high = np.percentile(values, [2.5, 97.5])
    return [round(float(low), 4), round(float(high), 4)]


def _by_axis(values: NDArray[np.float64]) -> dict[str, float]:
    return {axis: round(float(v), 4) for axis, v in zip(AXES, values, strict=True)}


def _intervals(drawn: NDArray[np.float64]) -> dict[str, list[float]]:
    return {axis: interval(drawn[:, k]) for k, axis in enumerate(AXES)}


class _Flown:
    """Figures of one controller, one row a seed, by group."""

    def __init__(self, traces: dict[str, list[Trace]], bootstrap: Bootstrap) -> None:
        self.traces = [t for flown in traces.values() for t in flown]
        self.position = {g: np.array([mean_position_error_m(t) for t in flown]) for g, flown in traces.items()}
        self.before = {g: np.array([position_error_before_m(t) for t in flown]) for g, flown in traces.items()}
        self.false_loss = np.mean([[false_loss(t) for t in flown] for flown in traces.values()], axis=0)
        self.both = np.mean(list(self.position.values()), axis=0)
        peaks = {g: np.array([peak_deg(t) for t in flown]) for g, flown in traces.items()}
        self.peak = {g: values.mean(axis=0) for g, values in peaks.items()}
        self.peak_drawn = {g: bootstrap.means(values) for g, values in peaks.items()}
        curves = {g: np.array([attitude_curve_deg(t) for t in flown]) for g, flown in traces.items()}
        self.mean_curve_peak = {g: values.mean(axis=0).max(axis=0) for g, values in curves.items()}
        self.mean_curve_drawn = {g: bootstrap.means(values).max(axis=1) for g, values in curves.items()}


def document(traces: list[Trace]) -> dict[str, Any]:
    """The JSON of ``nff compare``."""
    names = list(dict.fromkeys(t.case.controller for t in traces))
    seeds = sorted({t.case.seed for t in traces})
    table = {(t.case.controller, t.case.group, t.case.seed): t for t in traces}
    bootstrap = Bootstrap(len(seeds))
    flown = {n: _Flown({g: [table[n, g, seed] for seed in seeds] for g in GROUPS}, bootstrap) for n in names}
    out: dict[str, Any] = {"controllers": {}, "gap_closed": {}, "intervals": {}, "against_baseline": {}}
    for name, row in flown.items():
        out["controllers"][name] = {
            "mean_position_error_m": round(float(row.both.mean()), 4),
            "peak_attitude_error_deg": {g: _by_axis(row.peak[g]) for g in GROUPS},
            "crashes": sum(t.crashed for t in row.traces),
        }
        out["intervals"][name] = _details(row, bootstrap)
        if "baseline" in flown:
            out["against_baseline"][name] = _against(row, flown["baseline"], bootstrap)
    if {"baseline", "nff", "omniscient"} <= set(names):
        base, ours, best = (flown[name] for name in ("baseline", "nff", "omniscient"))
        out["gap_closed_intervals"], out["gap_closed_of_mean_curve"] = {}, {}
        for g in GROUPS:
            out["gap_closed"][g] = _by_axis(_share(base.peak[g], ours.peak[g], best.peak[g]))
            drawn = _share(base.peak_drawn[g], ours.peak_drawn[g], best.peak_drawn[g])
            out["gap_closed_intervals"][g] = _intervals(drawn)
            share = _share(base.mean_curve_peak[g], ours.mean_curve_peak[g], best.mean_curve_peak[g])
            drawn = _share(base.mean_curve_drawn[g], ours.mean_curve_drawn[g], best.mean_curve_drawn[g])
            out["gap_closed_of_mean_curve"][g] = {"share": _by_axis(share), "interval": _intervals(drawn)}
    return out


def _share(base: NDArray[np.float64], ours: NDArray[np.float64], best: NDArray[np.float64]) -> NDArray[np.float64]:
    return (base - ours) / (base - best)


def _details(row: _Flown, bootstrap: Bootstrap) -> dict[str, Any]:
    delays = [t.delay_s for t in row.traces if t.delay_s is not None]

    def with_interval(values: NDArray[np.float64]) -> list[float]:
        return [round(float(values.mean()), 4), *interval(bootstrap.means(values))]

    return {
        "mean_position_error_m": interval(bootstrap.means(row.both)),
        "mean_position_error_m_by_group": {g: with_interval(row.position[g]) for g in GROUPS},
        "position_error_before_m": with_interval(np.mean(list(row.before.values()), axis=0)),
        "false_loss": with_interval(row.false_loss),
        "peak_attitude_error_deg": {g: _intervals(row.peak_drawn[g]) for g in GROUPS},
        "peak_of_mean_attitude_error_deg": {g: _by_axis(row.mean_curve_peak[g]) for g in GROUPS},
        "named_right": sum(t.named == [t.case.motor] for t in row.traces),
        "named_wrong": sum(bool(set(t.named) - {t.case.motor}) for t in row.traces),
        "flights": len(row.traces),
        "isolation_median_s": round(float(np.median(delays)), 4) if delays else None,
        "isolation_worst_s": round(max(delays), 4) if delays else None,
    }


def _against(row: _Flown, base: _Flown, bootstrap: Bootstrap) -> dict[str, Any]:
    def change(ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> tuple[float, list[float]]:
        drawn = bootstrap.means(ours) / bootstrap.means(theirs) - 1.0
        return round(float(ours.mean() / theirs.mean()) - 1.0, 4), interval(drawn)

    value, spread = change(row.both, base.both)
    outer, outer_spread = change(row.position["outer"], base.position["outer"])
    return {
        "position_error_change": value,
        "interval": spread,
        "outer": {"position_error_change": outer, "interval": outer_spread},
    }
