"""Compile the emulated vehicle ahead of its first flight: ``python -m sitl.trials.warm_up``, as ``make env`` does."""

from __future__ import annotations

from nff_companion.core import vehicle
from sitl import airframe
from sitl.fleet import Fleet, FleetOptions
from sitl.serve.physics import Physics, PhysicsOptions


def compile_all() -> None:
    """All kernels; they are the same for every airframe and number of vehicles."""
    parameters = airframe.load(vehicle.path_of("octo-x"))
    Fleet(parameters, FleetOptions(seeds=[1]))
    Physics(parameters, PhysicsOptions())


if __name__ == "__main__":
    compile_all()
