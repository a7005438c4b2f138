"""``nff demo``: the same seed twice over UDP loopback, without and with the companion, each in its own process."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nff_companion.core import vehicle as vehicle_model
from nff_companion.errors import NffError
from nff_companion.mavlink.codec import Message
from sitl import airframe as plant_airframe
from sitl import rotation
from sitl.faults import Fault
from sitl.fleet import Fleet, FleetOptions
from sitl.server import Server
from sitl.trials import machine as machines
from sitl.trials.machine import Figures
from sitl.trials.process import DaemonProcess, config_text, free_port, keep_files
from sitl.uncertainty import Uncertainty

HEIGHT_M = 10.0
MODEL_ERROR = (
    0.1  # of mass, inertia and thrust: the companion knows its vehicle as well as one does after a calibration
)
FLY_ON_S = 12.0
_RECORD_EVERY = 8  # cycles
_START_TIMEOUT_S = 30.0
_ACTING = ("allocate", "override")


@dataclass(frozen=True, kw_only=True)
class DemoOptions:
    """What to fly."""

    airframe: str = "octo-x"
    failures: list[tuple[int, float]] = field(default_factory=lambda: [(1, 5.0), (3, 8.0)])
    wind_m_s: float = 4.0
    rate_hz: float = 200.0
    mode: str = "allocate"
    seed: int = 1


@dataclass(slots=True)
class Trace:
    """One flight at 50 Hz, and what the companion said in it."""

    time_s: list[float] = field(default_factory=list)
    tilt_deg: list[float] = field(default_factory=list)
    roll_pitch_yaw_deg: list[list[float]] = field(default_factory=list)
    position_error_m: list[float] = field(default_factory=list)
    output: list[list[float]] = field(default_factory=list)
    effectiveness_time_s: list[float] = field(default_factory=list)
    effectiveness: list[list[float]] = field(default_factory=list)
    events: list[tuple[float, int, bool, float]] = field(default_factory=list)
    crashed_at_s: float | None = None
    max_tilt_deg: float = 0.0
    max_position_error_m: float = 0.0
    figures: Figures | None = None  # of the machine, with a companion


@dataclass(slots=True)
class DemoResult:
    """The JSON document and the traces behind it."""

    options: DemoOptions
    baseline: Trace
    companion: Trace
    document: dict[str, Any]


class Recorder:
    """Hooks of a server that fill a trace."""

    def __init__(self, motors: int) -> None:
        self.trace = Trace()
        self._motors = motors
        self.companion_heard = False
        self.commands_sent = 0
        self._samples: list[tuple[float, int]] = []  # wall time and samples taken by the companion, first and last

    def cycle(self, fleet: Fleet) -> None:
        """Called after each cycle."""
        trace, state = self.trace, fleet.state
        if state.crashed[0]:
            if trace.crashed_at_s is None:
                trace.crashed_at_s = fleet.time_s
            return
        tilt = float(np.degrees(rotation.tilt_of(state.quaternion)[0]))
        error = float(np.linalg.norm(state.position_m[0] - fleet.autopilot.position.path[0]))
        trace.max_tilt_deg = max(trace.max_tilt_deg, tilt)
        trace.max_position_error_m = max(trace.max_position_error_m, error)
        if fleet.cycle % _RECORD_EVERY == 0:
            w, x, y, z = state.quaternion[0]
            angles = [
                np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
                np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)),
                np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
            ]
            trace.time_s.append(fleet.time_s)
            trace.tilt_deg.append(tilt)
            trace.roll_pitch_yaw_deg.append([float(a) for a in np.degrees(angles)])
            trace.position_error_m.append(error)
            trace.output.append(fleet.autopilot.output[0].tolist())

    @property
    def rate_hz(self) -> float:
        """Mean rate of the samples that the companion took, by the wall clock; 0 when it took none."""
        if len(self._samples) < 2:
            return 0.0
        (began, first), (ended, last) = self._samples
        return (last - first) / (ended - began)

    def message(self, message: Message, time_s: float) -> None:
        """Called with each message from a client."""
        kind = message.get_type()
        if kind == "NFF_COMPANION_STATUS":
            self.companion_heard = True
            self.commands_sent = message.commands_sent
            if message.samples:
                self._samples[1:] = [(time.monotonic(), message.samples)]
        elif kind == "NFF_EFFECTIVENESS":
            self.trace.effectiveness_time_s.append(time_s)
            self.trace.effectiveness.append(list(message.effectiveness[: self._motors]))
        elif kind == "NFF_FAULT_EVENT":
            self.trace.events.append((time_s, message.motor, bool(message.declared), message.effectiveness))


def _figures(server: Server, recorder: Recorder, options: DemoOptions, wall_s: float) -> Figures:
    port = server.fleet.autopilot.ports[0]
    return Figures(
        flown_s=server.fleet.time_s,
        wall_s=wall_s,
        asked_hz=options.rate_hz,
        rate_hz=recorder.rate_hz,
        commands_sent=recorder.commands_sent,
        stale=port.refused["stale"],
        expected=options.mode in _ACTING and bool(options.failures),
        acted=port.accepted > 0,
        late_cycles=server.late_cycles,
        lost_s=server.lost_s,
        crashed=bool(server.fleet.state.crashed[0]),
    )


def make_fleet(options: DemoOptions) -> Fleet:
    """The vehicle of one flight, in the air."""
    nominal = plant_airframe.load(vehicle_model.path_of(options.airframe))
    faults = [Fault(vehicle=0, motor=motor, start_s=at) for motor, at in options.failures]
    fleet_options = FleetOptions(
        seeds=[options.seed],
        wind_m_s=options.wind_m_s,
        turbulence_m_s=0.25 * options.wind_m_s,
        model_error=MODEL_ERROR,
        uncertainty=Uncertainty.calibrated(),
        height_m=HEIGHT_M,
    )
    return Fleet(nominal, fleet_options, faults)


def fly(options: DemoOptions, *, with_companion: bool, folder: Path) -> Trace:
    """One flight in real time. Raises NffError when the companion does not come up."""
    port = free_port()
    fleet = make_fleet(options)
    recorder = Recorder(fleet.parameters.motors)
    server = Server(fleet, [f"udpout:127.0.0.1:{port}"], on_cycle=recorder.cycle, on_message=recorder.message)
    until = max((at for _, at in options.failures), default=0.0) + FLY_ON_S
    try:
        if not with_companion:
            server.run(until, stop=lambda: recorder.trace.crashed_at_s is not None)
            return recorder.trace
        config = folder / "companion.toml"
        config.write_text(
            config_text(
                endpoint=f"udpin:127.0.0.1:{port}",
                airframe=options.airframe,
                mode=options.mode,
                rate_hz=options.rate_hz,
                socket=folder / "status.sock",
            ),
            encoding="utf-8",
        )
        with DaemonProcess(config, folder / "companion.log") as daemon:
            wait_for_companion(server, recorder, daemon)
            began = time.monotonic()
            server.run(until, stop=lambda: recorder.trace.crashed_at_s is not None)
            recorder.trace.figures = _figures(server, recorder, options, time.monotonic() - began)
        return recorder.trace
    finally:
        server.close()


def wait_for_companion(server: Server, recorder: Recorder, daemon: DaemonProcess) -> None:
    """Hold the vehicle's time until the companion speaks. Raises NffError when it ends or stays silent."""
    deadline = time.monotonic() + _START_TIMEOUT_S
    while not recorder.companion_heard:
        if daemon.process.poll() is not None:
            raise NffError(f"the companion ended with code {daemon.process.returncode} before the flight")
        if time.monotonic() > deadline:
            raise NffError(f"the companion did not speak within {_START_TIMEOUT_S:.0f} s")
        server.greet()
        time.sleep(0.02)  # pace of the greeting; the loop ends on the companion's word


def _described(trace: Trace) -> dict[str, Any]:
    return {
        "crashed": trace.crashed_at_s is not None,
        "max_tilt_deg": round(trace.max_tilt_deg, 2),
        "max_position_error_m": round(trace.max_position_error_m, 3),
    }


def describe(options: DemoOptions, baseline: Trace, companion: Trace, machine: dict[str, Any]) -> dict[str, Any]:
    """The JSON document of a demo."""
    declared = [(t, motor, eta) for t, motor, on, eta in companion.events if on]
    faults = []
    for motor, failed_at in options.failures:
        found = next(((t, eta) for t, m, eta in declared if m == motor and t >= failed_at), None)
        faults.append(
            {
                "motor": motor,
                "failed_at_s": failed_at,
                "isolated_at_s": None if found is None else round(found[0], 4),
                "delay_s": None if found is None else round(found[0] - failed_at, 4),
                "effectiveness": None if found is None else round(found[1], 3),
            }
        )
    failures = dict(options.failures)
    false_alarms = sum(1 for t, motor, _ in declared if motor not in failures or t < failures[motor])
    return {
        "options": {
            "airframe": options.airframe,
            "wind_m_s": options.wind_m_s,
            "rate_hz": options.rate_hz,
            "mode": options.mode,
            "seed": options.seed,
        },
        "baseline": _described(baseline),
        "companion": {**_described(companion), "faults": faults, "false_alarms": false_alarms},
        "machine": machine,
    }


def run(options: DemoOptions, say: Callable[[str], None], keep: Path | None = None) -> DemoResult:
    """Both flights. ``keep``: a folder for the daemon's configuration and log."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        say("flying without the companion ...")
        baseline = fly(options, with_companion=False, folder=folder)
        say("flying with the companion ...")
        try:
            companion = fly(options, with_companion=True, folder=folder)
        finally:
            if keep is not None:
                keep_files(folder, keep)
    assert companion.figures is not None
    document = describe(options, baseline, companion, machines.judge(companion.figures))
    return DemoResult(options, baseline, companion, document)


def crash_report(server: Server) -> dict[str, Any]:
    """What ``nff sitl --json`` prints at its end."""
    fleet = server.fleet
    return {
        "time_s": round(fleet.time_s, 3),
        "crashed": bool(fleet.state.crashed[0]),
        "max_tilt_deg": round(float(np.degrees(fleet.max_tilt_rad[0])), 2),
        "refused": dict(fleet.autopilot.ports[0].refused),
        "refused_messages": dict(server.refused),
        "lost_s": round(server.lost_s, 3),
    }


def side_by_side(document: dict[str, Any]) -> str:
    """Both flights as a small table."""
    base, comp = document["baseline"], document["companion"]
    lines = [f"{'':24}{'without':>12}{'companion':>12}"]
    for key, label in (("crashed", "crashed"), ("max_tilt_deg", "tilt, deg"), ("max_position_error_m", "off path, m")):
        lines.append(f"{label:24}{base[key]!s:>12}{comp[key]!s:>12}")
    for fault in comp["faults"]:
        found = "not found" if fault["delay_s"] is None else f"named after {1e3 * fault['delay_s']:.0f} ms"
        lines.append(f"motor {fault['motor']} failed at {fault['failed_at_s']:.1f} s: {found}")
    lines.append(f"false alarms: {comp['false_alarms']}")
    lines.append(machines.line(document["machine"]))
    return "\n".join(lines)
