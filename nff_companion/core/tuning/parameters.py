"""Which numbers a ground station may set by MAVLink's parameter protocol, and under which name."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from nff_companion.core.tuning import Tuning
from nff_companion.core.tuning.span import Field, fields


@dataclass(frozen=True)
class Served:
    """``name`` on the wire, at most 16 characters; ``key`` dotted under ``tuning``."""

    name: str
    key: str

    @cached_property
    def field(self) -> Field:
        """Its type, range and reason."""
        return next(field for field in fields(Tuning) if field.key == self.key)


SERVED = (
    Served("NFF_IMPROVEMENT", "decision.improvement_min"),
    Served("NFF_MARGIN", "decision.margin_min"),
    Served("NFF_EXPLAINED", "decision.explained_min"),
    Served("NFF_LOSS_SUDDEN", "decision.loss_sudden"),
    Served("NFF_LOSS_SLOW", "decision.loss_gradual"),
    Served("NFF_FAILED_MAX", "decision.failed_max"),
)
