"""What the flights of a campaign say: counts with their intervals, by what was flown."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy.stats import beta, chi2

Row = dict[str, Any]
_SURE = 0.95
KEYS = ("airframe", "manoeuvre", "fault", "event")


def at_most(count: int, of: int) -> float:
    """Share that is not exceeded, by 95 % (Clopper and Pearson, one-sided)."""
    return 1.0 if count >= of else float(beta.ppf(_SURE, count + 1, of - count))


def rate_at_most(count: int, hours: float) -> float:
    """Events an hour that are not exceeded, by 95 % (Poisson, one-sided)."""
    return float(0.5 * chi2.ppf(_SURE, 2 * (count + 1))) / hours if hours > 0.0 else float("inf")


def summarised(rows: list[Row]) -> dict[str, Any]:
    """Of ``rows`` of a store."""
    delays = np.array([row["delay_s"] for row in rows if row["delay_s"] is not None])
    failing = [row for row in rows if row["motors"]]
    hours = sum(row["until_s"] for row in rows) / 3600.0
    wrong = sum(bool(row["wrong"]) for row in rows)
    unnamed = [row for row in failing if row["delay_s"] is None]
    missed, sets = len(unnamed), sum(in_sets(row) for row in unnamed)
    return {
        "flights": len(rows),
        "right": sum(
            not (row["wrong"] or row["said_wrong"]) and (row["delay_s"] is not None or not row["motors"])
            for row in rows
        ),
        "wrong": wrong,  # flights in which a motor that works was declared
        "wrong_at_most": round(at_most(wrong, len(rows)), 6) if rows else None,
        "wrong_per_hour_at_most": round(rate_at_most(wrong, hours), 4),
        "missed": missed,
        "missed_at_most": round(at_most(missed, len(failing)), 6) if failing else None,
        "sets": sets,  # of the missed: the failure is among the sets of motors that were said
        "either": sum(bool(row["either"]) for row in rows),  # named as one of two motors above each other
        "partly": sum(bool(row["partly"]) for row in rows),
        "partly_wrong": sum(bool(set(row["partly"]) - set(row["motors"])) for row in rows),  # of a motor that works
        "said_wrong": sum(bool(row["said_wrong"]) for row in rows),  # said not to answer, or to give less, and it works
        "changes_most": max((row["changes"] for row in rows), default=0),  # declarations and lifts in one flight
        "flaps": sum(row["flaps"] or 0 for row in rows),  # changes of a motor within 5 s of its last one
        "hours": round(hours, 3),
        "delay_median_s": round(float(np.median(delays)), 4) if delays.size else None,
        "delay_p99_s": round(float(np.percentile(delays, 99.0)), 4) if delays.size else None,
        "delay_worst_s": round(float(delays.max()), 4) if delays.size else None,
        "survived": sum(row["survived"] for row in rows),
        "alone_survived": sum(row["alone_survived"] for row in rows),
        "lost_though_alone_survived": sum(row["alone_survived"] and not row["survived"] for row in rows),
        "tilt_median_deg": _median(row["tilt_deg"] for row in rows),
        "alone_tilt_median_deg": _median(row["alone_tilt_deg"] for row in rows),
        "tilts_more": sum(row["tilt_deg"] > row["alone_tilt_deg"] + 2.0 and row["alone_survived"] for row in rows),
    }


def by(rows: list[Row], *keys: str) -> dict[str, list[Row]]:
    """Rows of each value of ``keys``, in the order of their first."""
    out: dict[str, list[Row]] = {}
    for row in rows:
        out.setdefault(", ".join(str(row[key]) for key in keys), []).append(row)
    return out


def document(rows: list[Row]) -> dict[str, Any]:
    """All of it: ``whole``, ``tables`` by each key that has more than one value, and ``exceptions``."""
    tables = {}
    for key in KEYS:
        groups = by(rows, key)
        if len(groups) > 1:
            tables[key] = {name: summarised(group) for name, group in groups.items()}
    return {"whole": summarised(rows), "tables": tables, "exceptions": [row for row in rows if exception(row)]}


def in_sets(row: Row) -> bool:
    """Whether the motors that fail are one of the sets of which it was not known which it is."""
    return list(row["motors"]) in [list(motors) for motors in row["among"]]


def exception(row: Row) -> str:
    """What is not as it should be; empty: nothing."""
    if row["wrong"]:
        return f"declared {row['wrong']} at {row['wrong_s']} s"
    if row["fault"] == "total" and row["delay_s"] is None:
        sets = " or ".join("+".join(map(str, motors)) for motors in row["among"])
        return f"said as {sets}" if sets else "missed"
    if row["alone_survived"] and not row["survived"]:
        return "lost, though it flies on alone"
    if row["said_wrong"]:
        return f"said of {row['said_wrong']}, which work"
    works = sorted(set(row["partly"]) - set(row["motors"]))
    if works:
        return f"allocated around {works}, which work"
    return ""


def _median(values: Iterable[float]) -> float | None:
    found = list(values)
    return round(float(np.median(found)), 2) if found else None
