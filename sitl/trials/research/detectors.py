"""Which estimator a trial flies with: ours, or a peer."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from nff_companion.core.parts import FLOWN, Parts
from nff_companion.core.tuning import Tuning
from nff_companion.errors import ConfigError

DETECTORS = ("sparse", "published", "imm", "rls", "thrust-loss", "current")
# Of the published estimate alone a motor is declared that has lost enough of it for long enough: no onset is looked at.
BY_ESTIMATE_ALONE = Tuning().having("decision", improvement_min=1e9, direct_min=1e9)


@dataclass(frozen=True, kw_only=True)
class Detector:
    """What of the product it replaces."""

    parts: Parts
    tuning: Tuning = field(default_factory=Tuning)


def detector_of(name: str, joint: float = 0.0, *, rotor_speeds: bool = False) -> Detector:
    """By ``name``; ``rotor_speeds``: the ESCs report them. Raises ConfigError, MissingExtra."""
    if name == "current" and not rotor_speeds:
        raise ConfigError("detector 'current' goes by what the ESCs report: have the rotor speeds reported")
    if name == "sparse":
        return Detector(parts=replace(FLOWN, joint=joint))
    if name == "published":
        return Detector(parts=replace(FLOWN, name=name), tuning=BY_ESTIMATE_ALONE)
    if name == "imm":
        from sitl.trials.research.imm import ImmEstimator

        return Detector(parts=replace(FLOWN, name=name, estimator=ImmEstimator))
    if name in ("rls", "thrust-loss", "current"):
        from sitl.trials.research.simple_peers import Current, LeastSquares, ThrustLoss

        peers = {"rls": LeastSquares, "thrust-loss": ThrustLoss, "current": Current}
        return Detector(parts=replace(FLOWN, name=name, estimator=peers[name]))
    raise ConfigError(f"detector {name!r} is unknown: choose one of {', '.join(DETECTORS)}")
