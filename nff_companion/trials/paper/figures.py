"""Figures of merit with 95 % intervals by bootstrap over the seeds; every controller has the same seeds."""

from __future__ import annotations

from typing import Any

import numpy as np

from nff_companion.trials.paper.scenario import GROUPS, WINDOW_S, Trace

AXES = ("roll", "pitch", "yaw")
_DRAWS = 4000


def peak_deg(trace: Trace) -> np.ndarray:
    """Largest attitude error (3,) in the window after the failure; a crash counts as 90 degrees."""
    if trace.crashed and float(trace.time_s[-1]) < WINDOW_S:
        return np.full(3, 90.0)
    inside = (trace.time_s >= 0.0) & (trace.time_s <= WINDOW_S)
    return np.nanmax(np.abs(trace.attitude_error_deg[inside]), axis=0)


def mean_position_error_m(trace: Trace) -> float:
    """After the failure, while the vehicle was up."""
    return float(trace.position_error_m[trace.time_s >= 0.0].mean())


def _interval(values: np.ndarray) -> list[float]:
    low, high = np.percentile(values, [2.5, 97.5])
    return [round(float(low), 4), round(float(high), 4)]


def _with_interval(values: np.ndarray, draw: np.ndarray) -> list[float]:
    """Mean over the seeds, and its interval."""
    return [round(float(values.mean()), 4), *_interval(values[draw].mean(axis=1))]


def document(traces: list[Trace]) -> dict[str, Any]:
    """The JSON of ``nff compare``."""
    names = list(dict.fromkeys(t.case.controller for t in traces))
    seeds = sorted({t.case.seed for t in traces})
    draw = np.random.default_rng(1).integers(len(seeds), size=(_DRAWS, len(seeds)))
    table = {(t.case.controller, t.case.group, t.case.seed): t for t in traces}

    def gathered(name: str, group: str) -> tuple[np.ndarray, np.ndarray]:
        flown = [table[name, group, seed] for seed in seeds]
        return np.array([peak_deg(t) for t in flown]), np.array([mean_position_error_m(t) for t in flown])

    out: dict[str, Any] = {"controllers": {}, "gap_closed": {}, "intervals": {}, "against_baseline": {}}
    peaks = {(name, group): gathered(name, group) for name in names for group in GROUPS}
    for name in names:
        position = np.mean([peaks[name, group][1] for group in GROUPS], axis=0)  # (seeds,)
        flown = [t for t in traces if t.case.controller == name]
        delays = [t.delay_s for t in flown if t.delay_s is not None]
        out["controllers"][name] = {
            "mean_position_error_m": round(float(position.mean()), 4),
            "peak_attitude_error_deg": {
                group: dict(zip(AXES, np.round(peaks[name, group][0].mean(axis=0), 3).tolist(), strict=True))
                for group in GROUPS
            },
            "crashes": sum(t.crashed for t in flown),
        }
        out["intervals"][name] = {
            "mean_position_error_m": _interval(position[draw].mean(axis=1)),
            "mean_position_error_m_by_group": {
                group: [
                    round(float(peaks[name, group][1].mean()), 4),
                    *_interval(peaks[name, group][1][draw].mean(axis=1)),
                ]
                for group in GROUPS
            },
            "peak_attitude_error_deg": {
                group: {axis: _interval(peaks[name, group][0][:, k][draw].mean(axis=1)) for k, axis in enumerate(AXES)}
                for group in GROUPS
            },
            "named_right": sum(t.named == [t.case.motor] for t in flown),
            "named_wrong": sum(bool(set(t.named) - {t.case.motor}) for t in flown),
            "flights": len(flown),
            "isolation_median_s": round(float(np.median(delays)), 4) if delays else None,
            "isolation_worst_s": round(max(delays), 4) if delays else None,
        }
        if "baseline" in names:
            base = np.mean([peaks["baseline", group][1] for group in GROUPS], axis=0)
            ratios = position[draw].mean(axis=1) / base[draw].mean(axis=1) - 1.0
            value = float(position.mean() / base.mean()) - 1.0
            out["against_baseline"][name] = {"position_error_change": round(value, 4), "interval": _interval(ratios)}
    if {"baseline", "nff", "omniscient"} <= set(names):
        out["gap_closed_intervals"] = {}
        for group in GROUPS:
            base, ours, best = (peaks[name, group][0] for name in ("baseline", "nff", "omniscient"))
            share = (base.mean(axis=0) - ours.mean(axis=0)) / (base.mean(axis=0) - best.mean(axis=0))
            drawn = (base[draw].mean(axis=1) - ours[draw].mean(axis=1)) / (
                base[draw].mean(axis=1) - best[draw].mean(axis=1)
            )
            out["gap_closed"][group] = dict(zip(AXES, np.round(share, 4).tolist(), strict=True))
            out["gap_closed_intervals"][group] = {axis: _interval(drawn[:, k]) for k, axis in enumerate(AXES)}
    return out
