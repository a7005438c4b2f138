"""Keeps a multirotor flying after motor failures: Neural-Fly for fault tolerance on a companion computer.

from nff_companion import Companion, Condition, Mode, load_vehicle

companion = Companion(load_vehicle("octo-x"), rate_hz=200.0)
state = companion.start(Mode.OBSERVE)
for sample in samples:
    state, output = companion.step(state, sample, Condition())
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nff_companion.allocation import METHODS, allocator, authority, problem_for
    from nff_companion.companion import Companion
    from nff_companion.companion_state import CompanionState, Orders, Output
    from nff_companion.condition import Condition, Mode, Reason, Statement
    from nff_companion.core.sample import Sample
    from nff_companion.core.vehicle import Vehicle
    from nff_companion.core.vehicle import load as load_vehicle
    from nff_companion.errors import NffError
    from nff_companion.replay.run import replay

__version__ = "0.1.0"
__all__ = [
    "METHODS",
    "Companion",
    "CompanionState",
    "Condition",
    "Mode",
    "NffError",
    "Orders",
    "Output",
    "Reason",
    "Sample",
    "Statement",
    "Vehicle",
    "allocator",
    "authority",
    "load_vehicle",
    "problem_for",
    "replay",
]

# Taken when they are asked for: the daemon decides how many threads numpy may use before numpy is there.
_HOMES = {
    "allocation": ("METHODS", "allocator", "authority", "problem_for"),
    "companion": ("Companion",),
    "companion_state": ("CompanionState", "Orders", "Output"),
    "condition": ("Condition", "Mode", "Reason", "Statement"),
    "core.sample": ("Sample",),
    "core.vehicle": ("Vehicle",),
    "errors": ("NffError",),
    "replay.run": ("replay",),
}


def __getattr__(name: str) -> Any:
    if name == "load_vehicle":
        return import_module("nff_companion.core.vehicle").load
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"nff_companion.{home}"), name)
    raise AttributeError(f"module nff_companion has no {name!r}: choose one of {', '.join(__all__)}")
