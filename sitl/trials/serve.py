"""``nff sitl --serve-px4`` and ``--serve-ardupilot``: the plant as the physics of a real autopilot."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nff_companion.core import vehicle as vehicle_model
from nff_companion.errors import EndpointError
from sitl import airframe as plant_airframe
from sitl.faults import Fault
from sitl.serve.ardupilot_json import ArduPilotServer
from sitl.serve.physics import Physics, PhysicsOptions
from sitl.serve.px4_hil import Px4Server


@dataclass(frozen=True, kw_only=True)
class ServeOptions:
    """What to serve. ``failures`` are (motor, seconds of the plant's time)."""

    airframe: str = "octo-x"
    thrust_to_weight: float | None = None
    failures: list[tuple[int, float]] = field(default_factory=list)
    wind_m_s: float = 0.0
    model_error: float = 0.0
    seconds: float = 0.0
    seed: int = 1


def serve(options: ServeOptions, *, px4: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """Serve until the time is over, the autopilot leaves or the user interrupts; what the vehicle did."""
    plant = plant_airframe.load(vehicle_model.path_of(options.airframe), thrust_to_weight=options.thrust_to_weight)
    faults = [Fault(vehicle=0, motor=motor, start_s=start) for motor, start in options.failures]
    physics = Physics(
        plant,
        PhysicsOptions(
            seed=options.seed,
            wind_m_s=options.wind_m_s,
            turbulence_m_s=0.25 * options.wind_m_s,
            model_error=options.model_error,
        ),
        faults,
    )
    server: Px4Server | ArduPilotServer = Px4Server(physics, seed=options.seed) if px4 else ArduPilotServer(physics)
    say(f"{options.airframe}: waiting for {'PX4 on TCP 4560' if px4 else 'ArduPilot on UDP 9002 (--model JSON)'}")
    until = options.seconds or math.inf
    try:
        server.run(lambda: physics.time_s >= until)
    except KeyboardInterrupt:
        say("stopped")
    except EndpointError as error:
        say(str(error))
    finally:
        server.close()
    return {
        "time_s": round(physics.time_s, 3),
        "crashed": bool(physics.state.crashed[0]),
        "max_tilt_deg": round(float(np.degrees(physics.max_tilt_rad)), 2),
        "last_error": server.last_error,
    }
