"""``nff fly px4``: a stock PX4 in SITL with our plant as its physics, flown with and without the daemon."""

from __future__ import annotations

import os
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nff_companion.core import vehicle as vehicle_model
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import ConfigError, EndpointError
from nff_companion.mavlink.codec import dialect
from sitl import airframe as plant_airframe
from sitl import rotation
from sitl.faults import Fault
from sitl.plant import full_load_share
from sitl.serve.physics import Physics, PhysicsOptions
from sitl.serve.px4_hil import Px4Server
from sitl.trials.fly import flight
from sitl.trials.fly.pilot import Pilot
from sitl.trials.fly.px4_parameters import parameters
from sitl.trials.process import DaemonProcess, config_text, start

ENVIRONMENT = "NFF_PX4"
_MAIN_AUTO, _SUB_TAKEOFF, _SUB_HOLD = 4, 2, 3
_SIM_PORT, _GROUND_PORT, _OFFBOARD_PORT = 4560, 14550, 14540
_SETTLE_S = 4.0
_FAST = 4.0
_BEGIN_S = 42.0
_CLOCK_START_S = 1.0  # of the served time when the plant's is 0


@dataclass(frozen=True, kw_only=True)
class FlyOptions:
    """What to fly. ``binary`` lies in bin/ of a build folder that has etc/ beside it; ``thrust_to_weight`` is as a
    thrust stand would measure it: at full throttle, with the battery's sag."""

    binary: Path
    airframe: str = "px4-octo-x"
    thrust_to_weight: float | None = 1.55
    failures: list[int] = field(default_factory=lambda: [3])
    fail_at_s: float = 5.0
    fly_on_s: float = 15.0
    height_m: float = 30.0
    wind_m_s: float = 0.0
    rate_hz: float = 250.0
    mode: str = "allocate"
    seed: int = 1
    kill_and_land: bool = False  # then kill -9, land, and see that the next start restores every parameter


def binary_from(path: Path | None) -> Path:
    """The px4 binary from an option or the environment. Raises ConfigError when there is none."""
    found = flight.binary_from(path, ENVIRONMENT, "--px4")
    if not (found.parent.parent / "etc").is_dir():
        raise ConfigError(f"{found} is not an executable bin/px4 of a build folder with etc/ in it")
    return found


@contextmanager
def simulator(options: FlyOptions, vehicle: Vehicle, folder: Path) -> Iterator[Px4Server]:
    """PX4 and its physics, running."""
    ratio = None if options.thrust_to_weight is None else options.thrust_to_weight / full_load_share()
    plant = plant_airframe.load(vehicle_model.path_of(options.airframe), thrust_to_weight=ratio)
    wind = PhysicsOptions(seed=options.seed, wind_m_s=options.wind_m_s, turbulence_m_s=0.25 * options.wind_m_s)
    server = Px4Server(Physics(plant, wind), port=_SIM_PORT, seed=options.seed)
    server.speed = _FAST
    stop = threading.Event()
    failed: list[Exception] = []

    def serve() -> None:
        try:
            server.run(stop.is_set)
        except EndpointError as error:
            failed.append(error)

    build = options.binary.parent.parent
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PX4_")}
    environment.update(PX4_SIM_MODEL="none_iris", PX4_SYS_AUTOSTART="10016", **parameters(vehicle, options.height_m))
    thread = threading.Thread(target=serve, name="physics", daemon=True)
    with (folder / "px4.log").open("wb") as log:
        process = start(
            [str(options.binary), "-d", "-i", "0", "-w", str(folder), str(build / "etc")],
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
        )
        thread.start()
        try:
            yield server
        finally:
            stop.set()
            thread.join(5.0)
            process.kill()
            process.wait()
            server.close()


class Truth:
    """What the plant did, at each frame since it was started."""

    def __init__(self, server: Px4Server) -> None:
        self.server = server
        self.lowest_m = np.inf
        self.farthest_m = 0.0
        self.max_tilt_deg = 0.0
        self._squares: list[float] = []
        self.reference = server.physics.position_m.copy()
        self.height_m = -float(self.reference[2])

    def look(self) -> None:
        """Take the present state."""
        physics = self.server.physics
        self.lowest_m = min(self.lowest_m, -float(physics.position_m[2]))
        distance = float(np.linalg.norm(physics.position_m - self.reference))
        self.farthest_m = max(self.farthest_m, distance)
        self._squares.append(distance**2)
        tilt = float(np.degrees(rotation.tilt_of(physics.quaternion[None])[0]))
        self.max_tilt_deg = max(self.max_tilt_deg, tilt)

    def summary(self) -> dict[str, Any]:
        """As the demo has it, and the height lost."""
        return {
            "crashed": bool(self.server.physics.state.crashed[0]) or self.lowest_m < 0.5,
            "max_tilt_deg": round(self.max_tilt_deg, 2),
            "max_position_error_m": round(self.farthest_m, 3),
            "position_rms_m": round(float(np.sqrt(np.mean(self._squares or [0.0]))), 4),
            "height_lost_m": round(max(self.height_m - self.lowest_m, 0.0), 3),
        }


def _take_off(pilot: Pilot, server: Px4Server, options: FlyOptions) -> None:
    ids = dialect
    pilot.stream(ids.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 20.0)
    pilot.wait(lambda: pilot.local is not None, 60.0, "a position estimate")

    def arm() -> None:
        pilot.command(ids.MAV_CMD_DO_SET_MODE, 1.0, _MAIN_AUTO, _SUB_TAKEOFF)
        pilot.command(ids.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)

    pilot.wait(lambda: pilot.armed, 60.0, "arming", arm)
    height = -float(server.physics.position_m[2])
    pilot.wait(
        lambda: -float(server.physics.position_m[2]) > options.height_m - 0.5, 90.0, f"the height (at {height:.1f} m)"
    )
    hold = (_MAIN_AUTO << 16) | (_SUB_HOLD << 24)
    pilot.wait(
        lambda: pilot.last["HEARTBEAT"].custom_mode == hold,
        30.0,
        "hold",
        lambda: pilot.command(ids.MAV_CMD_DO_SET_MODE, 1.0, _MAIN_AUTO, _SUB_HOLD),
    )
    began = server.physics.time_s
    pilot.wait(lambda: server.physics.time_s - began > _SETTLE_S, 60.0, "the hover to settle")
    server.speed = 1.0


def fly(options: FlyOptions, *, with_companion: bool, folder: Path) -> dict[str, Any]:
    """One flight. Raises FlightError when it does not get as far as the failure, ConfigError, EndpointError."""
    vehicle = vehicle_model.load(options.airframe, thrust_to_weight=options.thrust_to_weight)
    pilot = Pilot(f"udpin:127.0.0.1:{_GROUND_PORT}", bytewise=True)
    with simulator(options, vehicle, folder) as server:
        try:
            pilot.connect(60.0)
            _take_off(pilot, server, options)
            if not with_companion:
                return _test(pilot, server, options)
            text = config_text(
                endpoint=f"udpin:127.0.0.1:{_OFFBOARD_PORT}",
                airframe=options.airframe,
                mode=options.mode,
                rate_hz=options.rate_hz,
                socket=folder / flight.SOCKET,
                thrust_to_weight=options.thrust_to_weight,
                state_folder=folder / "state",
            )
            before = _told(pilot, vehicle) if options.kill_and_land else {}
            with flight.companion(pilot, folder, text, rate_hz=options.rate_hz) as beside:
                summary, machine = beside.test(
                    lambda: _test(pilot, server, options),
                    lambda: server.physics.time_s,
                    expected=options.mode != "observe" and bool(options.failures),
                )
                if options.kill_and_land:
                    beside.daemon.kill()
            journal = folder / "state" / "parameters.journal"
            summary["journal_left"] = journal.exists()
            if options.kill_and_land:
                _land(pilot, server)
                during = _told(pilot, vehicle)
                with DaemonProcess(folder / flight.CONFIG, folder / flight.LOG):
                    pilot.wait(lambda: not journal.exists(), 60.0, "the restarted companion to restore")
                after = _told(pilot, vehicle)
                summary["changed_parameters"] = sum(during[name] != before[name] for name in before)
                summary["not_restored"] = [name for name in before if after[name] != before[name]]
            _judge(summary, options)
            return {**summary, "machine": machine}
        finally:
            pilot.close()


def _told(pilot: Pilot, vehicle: Vehicle) -> dict[str, float]:
    """What PX4 has been told of its rotors."""
    names = [f"CA_ROTOR{i}_{suffix}" for i in range(vehicle.motors) for suffix in ("CT", "KM")]
    return {name: pilot.parameter(name) for name in names}


def _land(pilot: Pilot, server: Px4Server) -> None:
    server.speed = _FAST
    pilot.wait(lambda: not pilot.armed, 120.0, "landing", lambda: pilot.command(dialect.MAV_CMD_NAV_LAND), again_s=10.0)
    server.speed = 1.0


def _test(pilot: Pilot, server: Px4Server, options: FlyOptions) -> dict[str, Any]:
    """From a fixed time of the plant on, so that every contender flies through the same turbulence."""
    physics = server.physics
    began = max(physics.time_s, _BEGIN_S)
    wall = 4.0 * (options.fail_at_s + options.fly_on_s) + 30.0
    pilot.wait(lambda: physics.time_s - began > options.fail_at_s, wall, "the time of the failure")
    truth = Truth(server)
    failed_at = physics.time_s
    for motor in options.failures:
        physics.faults.add(Fault(vehicle=0, motor=motor, start_s=failed_at))

    def over() -> bool:
        truth.look()
        return physics.time_s - failed_at > options.fly_on_s or truth.summary()["crashed"]

    pilot.hooks.append(lambda _: truth.look())
    pilot.wait(over, wall, "the end of the flight")
    return {**truth.summary(), "failed_at_s": failed_at + _CLOCK_START_S, "texts": pilot.texts[-6:]}


def run(options: FlyOptions, *, baseline: bool = True, keep: Path | None = None) -> dict[str, Any]:
    """The flight without and with the companion; the document that ``nff fly`` prints."""
    said = {
        "firmware": "px4",
        "airframe": options.airframe,
        "thrust_to_weight": options.thrust_to_weight,
        "failures": options.failures,
        "wind_m_s": options.wind_m_s,
        "rate_hz": options.rate_hz,
        "mode": options.mode,
        "seed": options.seed,
    }

    def one(with_companion: bool, folder: Path) -> dict[str, Any]:
        return fly(options, with_companion=with_companion, folder=folder)

    return flight.both(said, one, baseline=baseline, keep=keep)


def _judge(summary: dict[str, Any], options: FlyOptions) -> None:
    """What the companion found, by its own word."""
    status = summary.pop("status")
    declared = [e for e in status.get("events", []) if e["declared"]]
    summary["faults"] = []
    for motor in options.failures:
        found = next((e for e in declared if e["motor"] == motor), None)
        delay = None if found is None else round(found["time_s"] - summary["failed_at_s"], 4)
        summary["faults"].append(
            {
                "motor": motor,
                "failed_at_s": round(summary["failed_at_s"], 4),
                "isolated_at_s": None if found is None else found["time_s"],
                "delay_s": delay,
                "applied_delay_s": None,
                "effectiveness": None if found is None else found["effectiveness"],
            }
        )
    summary["false_alarms"] = sum(
        e["motor"] not in options.failures or e["time_s"] < summary["failed_at_s"] for e in declared
    )
    summary["rate_hz"], summary["slow_streams"] = status.get("rate_hz"), status.get("slow_streams")
    summary["told"] = (status.get("autopilot") or {}).get("failed")
