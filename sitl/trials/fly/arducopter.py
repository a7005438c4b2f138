"""``nff fly ardupilot``: a stock ArduCopter in its own simulator with our applet, with and without the daemon."""

from __future__ import annotations

import json
import subprocess
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nff_companion.autopilots.ardupilot.before import of_trial
from nff_companion.autopilots.ardupilot.install import install, parameter_file
from nff_companion.core import vehicle as vehicle_model
from nff_companion.core.vehicle import Vehicle
from nff_companion.mavlink.codec import dialect
from sitl.trials.fly import flight
from sitl.trials.fly.pilot import FlightError, Pilot
from sitl.trials.fly.record import FlightRecord, fault_report
from sitl.trials.process import config_text, start

ENVIRONMENT = "NFF_ARDUCOPTER"
_PORT = 5760  # of instance 0; ten further for each next one, and two further for its second serial port
_HOME = "47.3977,8.5456,488,0"
_GUIDED = 4
_BYPASS = 21196.0  # arm without the checks of the simulator's sensors
_FAST = 10.0
_SETTLE_S = 3.0
_SIDE_M = 20.0
_CORNER_M = 2.0
_FAULT_SCRIPT = """-- test only: fails the motors of the mask in SCR_USER1 and says when
local last = 0
function update()
  local mask = math.floor(param:get("SCR_USER1") or 0)
  if mask ~= last then
    last = mask
    param:set("SIM_ENGINE_MUL", 0)
    param:set("SIM_ENGINE_FAIL", mask)
    gcs:send_text(5, string.format("FAULT %d %d", mask, millis():toint()))
  end
  return update, 1
end
return update, 1
"""


@dataclass(frozen=True, kw_only=True)
class FlyOptions:
    """What to fly. ``failures`` are motors that fail together, ``fail_at_s`` after the hover is reached."""

    binary: Path
    airframe: str = "arducopter-octa-x"
    failures: list[int] = field(default_factory=lambda: [1])
    fail_at_s: float = 5.0
    fly_on_s: float = 15.0
    height_m: float = 10.0
    wind_m_s: float = 5.0
    turbulence: float = 0.0
    speed_m_s: float = 0.0  # above 0: a square at this speed
    rate_hz: float = 200.0
    mode: str = "allocate"
    instance: int = 0


def binary_from(path: Path | None) -> Path:
    """The arducopter binary from an option or the environment. Raises ConfigError when there is none."""
    return flight.binary_from(path, ENVIRONMENT, "--arducopter")


class Simulator:
    """One arducopter process in a scratch directory; a context manager."""

    def __init__(self, options: FlyOptions, vehicle: Vehicle, folder: Path, *, with_applet: bool) -> None:
        self._options = options
        self._log = (folder / "arducopter.log").open("wb")
        scripts = folder / "scripts"
        scripts.mkdir()
        if with_applet:
            install(vehicle, scripts, of_trial(vehicle))
        (scripts / "fault.lua").write_text(_FAULT_SCRIPT, encoding="utf-8")
        places = {f"motor{i + 1}_position": [*vehicle.position_m[i].tolist(), 0.0] for i in range(vehicle.motors)}
        (folder / "frame.json").write_text(json.dumps({"num_motors": vehicle.motors, **places}), encoding="utf-8")
        (folder / "nff.parm").write_text(self._parameters(vehicle, with_applet=with_applet), encoding="utf-8")
        command = [str(options.binary), "--model", "octa:frame.json", "--speedup", str(_FAST), f"-I{options.instance}"]
        command += ["--home", _HOME, "--defaults", "nff.parm"]
        self.process = start(command, cwd=folder, stdin=subprocess.DEVNULL, stdout=self._log, stderr=subprocess.STDOUT)

    def _parameters(self, vehicle: Vehicle, *, with_applet: bool) -> str:
        o, command = self._options, vehicle.command
        lines = [parameter_file(vehicle, scripted=with_applet)]
        if not with_applet:
            lines += ["FRAME_CLASS 3", "FRAME_TYPE 1"]
        lines += [
            f"MOT_THST_EXPO {command.thrust_expo}",
            f"MOT_SPIN_MIN {command.spin_min}",
            f"MOT_SPIN_MAX {command.spin_max}",
            f"MOT_PWM_MIN {command.pwm_min:.0f}",
            f"MOT_PWM_MAX {command.pwm_max:.0f}",
            "MOT_THST_HOVER 0.39",
            # the simulated yaw is weak: the gains of the simulator's own octorotor
            "ATC_RAT_YAW_P 0.3",
            "ATC_RAT_YAW_I 0.02",
            "FRAME_TYPE 1",
            "FS_THR_ENABLE 0",
            "FS_GCS_ENABLE 0",
            "FS_EKF_ACTION 0",
            "FENCE_ENABLE 0",
            "SCHED_LOOP_RATE 400",
            "SERIAL1_PROTOCOL 2",
            # calibrations that the simulated sensors are known by
            *(f"INS_ACC{i}OFFS_{axis} 0.001" for i in ("", "2", "3") for axis in "XYZ"),
            *(f"INS_ACC{i}SCAL_{axis} 1.001" for i in ("", "2", "3") for axis in "XYZ"),
            "COMPASS_OFS_X 5",
            "COMPASS_OFS_Y 13",
            "COMPASS_OFS_Z -18",
            f"SIM_WIND_SPD {o.wind_m_s}",
            "SIM_WIND_DIR 30",
            f"SIM_WIND_TURB {o.turbulence}",
        ]
        return "\n".join([*lines, ""])

    def __enter__(self) -> Simulator:
        return self

    def __exit__(self, *_: tuple[type[BaseException], BaseException, TracebackType]) -> None:
        self.process.kill()
        self.process.wait()
        self._log.close()


def companion_port(options: FlyOptions) -> int:
    """TCP port of the second serial port, where the companion is connected."""
    return _PORT + 10 * options.instance + 2


def square(centre: tuple[float, float, float]) -> NDArray[np.float64]:
    """(5, 3) corners of the square flown, the first one again at the end."""
    x, y, z = centre
    corners = [(0, 0), (_SIDE_M, 0), (_SIDE_M, _SIDE_M), (0, _SIDE_M), (0, 0)]
    return np.array([(x + a, y + b, z) for a, b in corners])


def fly(options: FlyOptions, *, with_companion: bool, folder: Path) -> dict[str, Any]:
    """One flight. Raises FlightError when it does not get as far as the failure, ConfigError."""
    vehicle = vehicle_model.load(options.airframe)
    record = FlightRecord()
    pilot = Pilot(f"tcp:127.0.0.1:{_PORT + 10 * options.instance}")
    pilot.hooks.append(record.observe)
    with Simulator(options, vehicle, folder, with_applet=with_companion) as simulator:
        try:
            pilot.connect(30.0)
            take_off(pilot, options)
            pilot.set_parameter("SIM_SPEEDUP", 1.0)
            if not with_companion:
                return _test(pilot, record, options)
            text = config_text(
                endpoint=f"tcp:127.0.0.1:{companion_port(options)}",
                airframe=options.airframe,
                mode=options.mode,
                rate_hz=options.rate_hz,
                socket=folder / flight.SOCKET,
            )
            with flight.companion(pilot, folder, text, rate_hz=options.rate_hz) as beside:
                summary, machine = beside.test(
                    lambda: _test(pilot, record, options),
                    lambda: record.now_s,
                    expected=options.mode != "observe" and bool(options.failures),
                )
            _judge(summary, record, options)
            return {**summary, "machine": machine}
        except FlightError as error:
            if simulator.process.poll() is not None:
                raise FlightError(f"arducopter ended with code {simulator.process.returncode}: {error}") from error
            raise
        finally:
            pilot.close()


def _judge(summary: dict[str, Any], record: FlightRecord, options: FlyOptions) -> None:
    """What the companion found, by its own word: the autopilot does not pass private messages on to the pilot."""
    status = summary.pop("status")
    record.events = [(e["time_s"], e["motor"], e["declared"], e["effectiveness"]) for e in status.get("events", [])]
    summary["faults"], summary["false_alarms"] = fault_report(record, options.failures)
    summary["rate_hz"], summary["slow_streams"] = status.get("rate_hz"), status.get("slow_streams")
    summary["refused"] = (status.get("autopilot") or {}).get("refused")


def take_off(pilot: Pilot, options: FlyOptions) -> None:
    """From boot to a hover at the height. Raises FlightError."""
    ids = dialect
    for message_id, hz in ((ids.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 50.0), (ids.MAVLINK_MSG_ID_ATTITUDE, 50.0)):
        pilot.stream(message_id, hz)
    pilot.wait(
        lambda: pilot.local is not None and any("using GPS" in text for text in pilot.texts),
        90.0,
        "a position estimate",
        lambda: pilot.stream(ids.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 50.0),
    )
    pilot.wait(
        lambda: pilot.last["HEARTBEAT"].custom_mode == _GUIDED,
        20.0,
        "mode GUIDED",
        lambda: pilot.command(ids.MAV_CMD_DO_SET_MODE, 1.0, _GUIDED),
    )
    pilot.wait(
        lambda: pilot.armed, 60.0, "arming", lambda: pilot.command(ids.MAV_CMD_COMPONENT_ARM_DISARM, 1.0, _BYPASS)
    )
    pilot.wait(
        lambda: pilot.local is not None and -pilot.local[2] > options.height_m - 0.3,
        60.0,
        "the height",
        lambda: pilot.command(ids.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, options.height_m),
    )


def _go(pilot: Pilot, corner: NDArray[np.float64]) -> None:
    mask = 0b110111111000  # position alone
    pilot.send(
        dialect.MAVLink_set_position_target_local_ned_message(
            0, *pilot.target, dialect.MAV_FRAME_LOCAL_NED, mask, *corner.tolist(), *[0.0] * 8
        )
    )


def _test(pilot: Pilot, record: FlightRecord, options: FlyOptions) -> dict[str, Any]:
    """Hover or square, the failure, and on; what came of it."""
    start = pilot.local
    assert start is not None

    def now() -> float:
        return record.now_s

    began = now()
    wall = max(4.0 * (options.fail_at_s + options.fly_on_s), 60.0)
    pilot.wait(lambda: now() - began > _SETTLE_S, wall, "the hover to settle")
    path = np.array([pilot.local])
    corner = [1]

    def fly_corner() -> None:
        here = pilot.local
        if len(path) == 1 or here is None:
            return
        if np.linalg.norm(np.array(here) - path[corner[0]]) < _CORNER_M:
            corner[0] = corner[0] % 4 + 1
        _go(pilot, path[corner[0]])

    if options.speed_m_s > 0.0:
        path = square((start[0], start[1], -options.height_m))
        pilot.command(dialect.MAV_CMD_DO_CHANGE_SPEED, 1.0, options.speed_m_s, -1.0)
    else:
        _go(pilot, path[0])
    begun = now()
    pilot.wait(lambda: now() - begun > options.fail_at_s, wall, "the time of the failure", fly_corner, 0.2)
    if options.speed_m_s == 0.0:
        times, points = np.array(record.time_s), np.array(record.position_m)
        path = points[times > now() - 2.0].mean(axis=0)[None]
    failed_at = now()
    mask = sum(1 << (motor - 1) for motor in options.failures)
    if mask:
        pilot.wait(
            lambda: bool(record.faults),
            10.0,
            "the failure",
            lambda: pilot.send(
                dialect.MAVLink_param_set_message(
                    *pilot.target, b"SCR_USER1", float(mask), dialect.MAV_PARAM_TYPE_REAL32
                )
            ),
        )
        failed_at = record.faults[0][0]
    before = record.summary(path, begun, failed_at)

    def over() -> bool:
        return now() - failed_at > options.fly_on_s or record.summary(None, failed_at, now())["crashed"]

    pilot.wait(over, wall, "the end of the flight", fly_corner, 0.2)
    return {"before": before, **record.summary(path, failed_at, now())}


def run(options: FlyOptions, *, baseline: bool = True, keep: Path | None = None) -> dict[str, Any]:
    """The flight without and with the companion; the document that ``nff fly`` prints."""
    said = {
        "firmware": "arducopter",
        "airframe": options.airframe,
        "failures": options.failures,
        "wind_m_s": options.wind_m_s,
        "speed_m_s": options.speed_m_s,
        "rate_hz": options.rate_hz,
        "mode": options.mode,
    }

    def one(with_companion: bool, folder: Path) -> dict[str, Any]:
        return fly(options, with_companion=with_companion, folder=folder)

    return flight.both(said, one, baseline=baseline, keep=keep)
