"""What is gathered while a log goes through the companion, and what is said of it in the end."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Verdict = Literal["fault", "no_fault", "not_judged"]


@dataclass
class Fault:
    """A declaration; times in s from the first record, ``motor`` from 1."""

    motor: int
    time_s: float
    effectiveness: float
    confidence: float
    lifted_s: float | None = None


@dataclass(frozen=True)
class Judgement:
    """``explained`` (n,) of the axes, None: too little flight. ``faults`` are empty unless the verdict is fault."""

    verdict: Verdict
    reason: str
    judged_s: float
    refused: int
    explained: NDArray[np.float64] | None
    faults: list[Fault]


@dataclass
class Watch:
    """What is gathered while a log goes through the companion."""

    faults: list[Fault] = field(default_factory=list)
    judged_s: float = 0.0
    refused_armed: int = 0
    used_armed: int = 0
    troubles: Counter[str] = field(default_factory=Counter)
    measured: list[NDArray[np.float64]] = field(default_factory=list)  # (n,) each, of the healthy part
    residual: list[NDArray[np.float64]] = field(default_factory=list)
    shown: list[NDArray[np.float64]] = field(default_factory=list)  # (m,) each, thrust fractions as they show in them
    times: list[float] = field(default_factory=list)  # s from the first record, of each
    # What follows the first declaration, until there is another one or it is lifted, in the same way: (n,), (m,) each.
    residual_after: list[NDArray[np.float64]] = field(default_factory=list)
    shown_after: list[NDArray[np.float64]] = field(default_factory=list)
    thrust_max: float = 0.0  # of the mean of the motors while armed
    doubtful: tuple[int, ...] = ()  # motors (from 0) that were convincing, and too many to be declared
    doubtful_since_s: float | None = None
    works_from: float = 1.0  # effectiveness, as the decision has it
    suspects: tuple[int, ...] = ()
