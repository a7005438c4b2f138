"""What a flight says of its airframe file: numbers in, a verdict and true sentences out. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

import msgspec

from nff_companion.core.tuning import FitTuning

TURNS = ("roll", "pitch", "yaw")


class FitVerdict(Enum):
    """Whether the airframe file is that of the vehicle that flies."""

    UNKNOWN = "unknown"  # too little seen, or off by more than is acted upon
    FITS = "fits"
    DOES_NOT_FIT = "does_not_fit"


@dataclass(frozen=True, slots=True)
class Factor:
    """What flies, over what the file says: somewhere between ``low`` and ``high``."""

    low: float
    high: float

    @property
    def middle(self) -> float:
        """The best guess."""
        return math.sqrt(self.low * self.high)

    @property
    def least(self) -> float:
        """The end nearer to 1: it is off by so much at least; 1 where it may be right."""
        return max(self.low, 1.0) if self.high > 1.0 else self.high

    def beyond(self, limit: float) -> bool:
        """Whether it is off by more than the factor ``limit``, either way, for certain."""
        return not 1.0 / limit <= self.least <= limit


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """The numbers of one judgement; None: not known."""

    seconds: float  # of flight that is remembered
    thrust: Factor | None = None
    turns: tuple[Factor | None, Factor | None, Factor | None] = (None, None, None)
    explained: tuple[float, float, float] = (0.0, 0.0, 0.0)  # share of roll, pitch, yaw that the commands explain
    later_s: float | None = None  # that motors answer later than the file says
    order: str = ""  # the likeliest, in words; empty: the file's
    margin: float = 0.0  # chi squared from the file's order to the likeliest other; below 0: that one is likelier
    turned: bool = False  # the likeliest other is the file's, with its nose elsewhere
    ambiguous: bool = False  # another wrong order is nearly as likely as the likeliest one
    misfit: float = 0.0  # chi squared of the file's order
    least_misfit: float = 0.0  # and of the likeliest other


class Fit(msgspec.Struct, frozen=True, kw_only=True):
    """A judgement. ``short`` for the pilot's 50 letters, ``text`` a sentence with numbers; ``differs``: what is worth
    saying though it does not decide, as (short, text)."""

    verdict: FitVerdict = FitVerdict.UNKNOWN
    short: str = "nothing flown"
    text: str = "not yet known: nothing flown"
    differs: tuple[tuple[str, str], ...] = ()
    seen: Seen = Seen(seconds=0.0)


NOTHING = Fit()


def judged(seen: Seen, tuning: FitTuning) -> Fit:
    """What ``seen`` says."""
    wrong = tuple(_wrong(seen, tuning))
    if wrong:
        short, text = wrong[0]
        return Fit(verdict=FitVerdict.DOES_NOT_FIT, short=short, text=text, seen=seen)
    differs = tuple(_differs(seen, tuning))
    open_questions = tuple(_open(seen, tuning))
    numbers = _numbers(seen)
    if not open_questions:
        text = "; ".join(["fits", *(said for _, said in differs), numbers])
        return Fit(verdict=FitVerdict.FITS, short="fits", text=text, differs=differs, seen=seen)
    text = "; ".join([f"not yet known: {open_questions[0]}", *(said for _, said in differs), numbers])
    return Fit(short=open_questions[0], text=text, differs=differs, seen=seen)


def _wrong(seen: Seen, tuning: FitTuning) -> Iterator[tuple[str, str]]:
    """What no vehicle of this file does, the plainest first."""
    if seen.margin <= -(tuning.nose_margin if seen.turned else tuning.order_margin):
        if seen.ambiguous or seen.least_misfit > tuning.misfit_max:
            yield "motors in another order", "the motors are in another order, or of another frame, than the file says"
        else:
            yield seen.order, f"{seen.order}, as the motion shows"
    elif seen.misfit > tuning.misfit_wrong:
        yield "not this frame", "no order of this file's motors moves as this vehicle does: another frame"
    else:
        for axis, factor in zip(TURNS, seen.turns, strict=True):
            if factor is not None and factor.beyond(tuning.wrong_turn):
                yield _off(axis, factor)
    if seen.thrust is not None and seen.thrust.beyond(tuning.wrong_thrust):
        yield _off("thrust", seen.thrust)


def _differs(seen: Seen, tuning: FitTuning) -> Iterator[tuple[str, str]]:
    """What is off by more than measurement is."""
    if seen.thrust is not None and seen.thrust.beyond(tuning.said_thrust):
        yield _off("thrust", seen.thrust)
    for axis, factor in zip(TURNS, seen.turns, strict=True):
        if factor is not None and factor.beyond(tuning.said_turn):
            yield _off(axis, factor)
    if seen.later_s is not None and abs(seen.later_s) > tuning.said_lag_s:
        way = "later" if seen.later_s > 0.0 else "sooner"
        answer = f"motors answer {1e3 * abs(seen.later_s):.0f} ms {way}"
        yield f"{answer}", f"{answer} than the file says"


def _off(axis: str, factor: Factor) -> tuple[str, str]:
    times = f"{factor.least:.2f} times"
    if axis == "thrust":
        return f"thrust is {times} its", f"thrust over mass is {times} what the file says"
    return f"{axis} is {times} its", f"it turns about {axis} {times} as much as the file says"


def _open(seen: Seen, tuning: FitTuning) -> Iterator[str]:
    """What must be known, or nearer, before the file is taken to fit."""
    if seen.thrust is None:
        yield f"{seen.seconds:.0f} s flown"
        return
    for name, factor in (("thrust", seen.thrust), *zip(TURNS, seen.turns, strict=True)):
        if factor is not None and factor.beyond(tuning.fits):
            yield f"{name} too far off"
    if seen.later_s is not None and abs(seen.later_s) > tuning.said_lag_s:
        yield f"motors answer too {'late' if seen.later_s > 0.0 else 'soon'}"
    unseen = [axis for axis, factor in zip(TURNS, seen.turns, strict=True) if factor is None]
    if unseen:
        yield f"too little {', '.join(unseen)} flown"
    elif seen.margin < tuning.order_margin:
        yield "too little flown to tell the motors' order"
    elif seen.misfit > tuning.misfit_max:
        yield "motors do not quite share as the file says"


def _numbers(seen: Seen) -> str:
    factors = (("thrust", seen.thrust), *zip(TURNS, seen.turns, strict=True))
    known = ", ".join(f"{name} {factor.middle:.2f}" for name, factor in factors if factor is not None)
    return f"{known or 'nothing'} of the file's"
