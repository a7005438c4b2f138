"""The vehicle of a flight, made of its log alone: the frame by parameters, by name or by what explains the motion; the
thrust of hover, inertia and lag by how it flew. The arm is a typical one: thrust and inertia go with it.
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from nff_companion.core import toml_file
from nff_companion.core.airframe_file import AirframeFile, LogTable, fault_of
from nff_companion.core.vehicle import AXES, GRAVITY_M_S2, Vehicle
from nff_companion.errors import ConfigError, NotJudged
from nff_companion.frames import ardupilot, catalogue, px4
from nff_companion.frames import draft as frame_draft
from nff_companion.frames.catalogue import Frame
from nff_companion.frames.draft import Size
from nff_companion.frames.parameter_file import Parameters
from nff_companion.frames.reading import Reading
from nff_companion.replay import log_fit
from nff_companion.replay.flight import LogFlight
from nff_companion.replay.flight import Reading as Samples
from nff_companion.replay.log_fit import Fit, Motion
from nff_companion.replay.run import checked
from nff_companion.replay.thinning import thinned

ARM_M = 0.25  # of a typical vehicle with four places for motors; it grows with the root of how many there are
_UNREAD_N = 1000.0  # full thrust of a motor while thrusts in N are read whose range is not known
_HOVERS = 0.4  # such motors do so at, or at more where they were seen to give less than the rest
_HOVER = (0.06, 0.9)  # thrust fraction
_EXPLAINED_MIN = 0.2  # of an axis, for its gain to count
_GAIN = (0.2, 5.0)  # over the guess: beyond it something else than inertia is wrong
_DRAG_PER_ARM = (2e-3, 0.4)
# A frame is told by the motion where roll and pitch are explained, and another one explains less by so much.
_TOLD_MIN, _TOLD_MARGIN = 0.3, 0.1
# Cosine of the angle between their rows of frames that have the same motors at nearly the same places: nobody mistakes
# a motor of one for another of the other. Outputs of a mixer do not tell an octo H from an octo X: the commoner counts.
_ALIKE, _SAME = 0.9, 0.02
_NO_FRAME = "the log does not say which frame: give --frame (`nff airframe list` names them)"
_SCRIPTED = (0, 15, 17)  # FRAME_CLASS that says no frame
_LEFT_OUT = ("MOT_THST_HOVER", "MPC_THR_HOVER")  # the log shows it


def vehicle_of(
    flight: LogFlight, frame_name: str | None = None, outputs: LogTable | None = None
) -> tuple[Vehicle, list[str]]:
    """The vehicle, and in sentences how it was made. ``frame_name`` of the catalogue; None: the log says it, or its
    motion does. ``outputs``: where a ULog keeps the commands, None: found. Raises NotJudged with what is missing."""
    made = made_of(flight, frame_name, outputs)
    return made.vehicle, made.notes


@dataclass(frozen=True)
class Made:
    """``samples`` as the vehicle reads them, which it was made of; ``notes`` in sentences how."""

    vehicle: Vehicle
    notes: list[str]
    samples: Samples


def made_of(flight: LogFlight, frame_name: str | None = None, outputs: LogTable | None = None) -> Made:
    """As ``vehicle_of``, with the samples thinned."""
    values = _values(flight)
    named = catalogue.by_name(frame_name) if frame_name else None
    if named is None and not _says_frame(flight, values):
        return _tried(flight, values, outputs)
    draft = _Draft.of(flight, values, named, outputs)
    how = f"frame {draft.name}, " + ("as given" if named is not None else "by the log's parameters")
    samples, motion = _motion(flight, draft.vehicle)
    return _finished(flight, draft, samples, motion, [how])


def draft_text(flight: LogFlight, frame_name: str | None, size: Size) -> str:
    """An airframe file of the log's parameters and frame, and guesses for the rest; ``frame_name`` as for
    ``vehicle_of``. Raises NotJudged, ConfigError."""
    values = _values(flight)
    named = catalogue.by_name(frame_name) if frame_name else None
    if named is None and not _says_frame(flight, values):
        named = catalogue.by_name(_tried(flight, values, None).vehicle.name)
    reading = _reading(flight, values, named)
    name = "frame of the log" if reading.frame is None else reading.frame.name
    return frame_draft.draft(reading, size, name, f"parameters in {flight.path.name}").text


def frame_of(vehicle: Vehicle) -> Frame:
    """For drawings."""
    return Frame(vehicle.name, catalogue.scaled(vehicle.hub_position_m), vehicle.spin)


@dataclass(frozen=True)
class _Draft:
    """A vehicle before anything of the flight is known."""

    name: str
    data: AirframeFile
    reading: Reading
    arm_m: float

    @property
    def vehicle(self) -> Vehicle:
        return Vehicle(self.data)

    @staticmethod
    def of(flight: LogFlight, values: dict[str, float], frame: Frame | None, outputs: LogTable | None = None) -> _Draft:
        """Raises NotJudged."""
        try:
            reading = _reading(flight, values, frame)
            places = len(np.unique(np.round(reading.place, 2) + 0.0, axis=0))
            arm_m = ARM_M * math.sqrt(places / 4.0)
            name = "frame of the log" if reading.frame is None else reading.frame.name
            text = frame_draft.draft(reading, Size(arm_m), name, "made of a flight log").text
            data = toml_file.converted(tomllib.loads(text), AirframeFile, Path(name), "airframe")
        except ConfigError as error:
            raise NotJudged(str(error)) from error
        data = msgspec.structs.replace(data, log=outputs)
        if outputs is not None and outputs.unit == "N":
            data = msgspec.structs.replace(data, motor=msgspec.structs.replace(data.motor, max_thrust_n=_UNREAD_N))
        return _Draft(name, data, reading, arm_m)


# -- the frame ----------------------------------------------------------------------------------------------------


def _values(flight: LogFlight) -> dict[str, float]:
    """Parameters at take-off that the vehicle is made of. Which output is whose the readers look at."""
    values = flight.parameters.at(flight.take_off_s)
    kept = {
        name: value
        for name, value in values.items()
        if name not in _LEFT_OUT and not (name.startswith("SERVO") and name.endswith("_FUNCTION"))
    }
    channel = int(kept.get("RCMAP_THROTTLE", 3))
    for end in ("MIN", "MAX"):  # 0 stands for the stick's range, where that is in the log
        if kept.get(f"MOT_PWM_{end}") == 0.0 and f"RC{channel}_{end}" not in kept:
            del kept[f"MOT_PWM_{end}"]
    return kept


def _says_frame(flight: LogFlight, values: dict[str, float]) -> bool:
    if flight.autopilot == "px4":
        start = values.get("SYS_AUTOSTART")
        return "CA_ROTOR0_PX" in values or (start is not None and catalogue.of_px4(int(start)) is not None)
    return values.get("FRAME_CLASS") not in (None, *map(float, _SCRIPTED)) and "FRAME_TYPE" in values


def _reading(flight: LogFlight, values: dict[str, float], frame: Frame | None) -> Reading:
    """Raises ConfigError."""
    origin = "the log's parameters"
    if flight.autopilot != "px4":
        return ardupilot.read(Parameters(values, origin), frame)
    try:
        return px4.read(Parameters(values, origin), frame)
    except ConfigError:
        # Pulses matter where the log has pulses: the reader looks at them then.
        rest = {name: value for name, value in values.items() if not name.startswith("PWM_")}
        return px4.read(Parameters(rest, origin), frame)


def _tried(flight: LogFlight, values: dict[str, float], outputs: LogTable | None) -> Made:
    """The frame of as many motors as the log has that explains the motion, and no other does. Raises NotJudged."""
    motors = None if flight.frame is None else flight.frame.motors
    kinds = _kinds(flight, values, motors)
    if motors is None or not kinds:
        said = "" if flight.frame is None else f" (it says: {flight.frame.text})"
        raise NotJudged(_NO_FRAME + said)
    samples, motion = _motion(flight, _Draft.of(flight, values, kinds[0], outputs).vehicle)
    if motion is None:
        raise NotJudged(f"{_NO_FRAME}; there is too little flight to see it")
    all_made = [_Draft.of(flight, values, frame, outputs) for frame in kinds]
    fits = [log_fit.fit(flight.fit(made.vehicle), motion).explained for made in all_made]
    scores = [float(explained.mean()) if explained[:2].min() >= _TOLD_MIN else 0.0 for explained in fits]
    best = max(scores)
    if best <= 0.0:
        raise NotJudged(f"{_NO_FRAME}; no frame of {motors} motors explains the motion")
    first = next(k for k, score in enumerate(scores) if score >= best - _SAME)
    others = [(score, k) for k, score in enumerate(scores) if not _alike(kinds[first], kinds[k])]
    second, rival = max(others, default=(0.0, first))
    if best - second < _TOLD_MARGIN:
        raise NotJudged(f"{_NO_FRAME}; {kinds[first].name} and {kinds[rival].name} explain the motion alike")
    how = (
        f"frame {kinds[first].name}: of {len(kinds)} with {motors} motors it explains the motion"
        f" ({scores[first]:.2f}; of those that are not alike the next {second:.2f})"
    )
    return _finished(flight, all_made[first], samples, motion, [how])


def _kinds(flight: LogFlight, values: dict[str, float], motors: int | None) -> list[Frame]:
    """Frames of so many motors that the parameters allow."""
    frame_class = values.get("FRAME_CLASS")
    said = None if frame_class is None or int(frame_class) in _SCRIPTED else int(frame_class)
    return [
        frame
        for frame in catalogue.frames().values()
        if frame.motors == motors
        and not frame.without
        and (flight.autopilot != "ardupilot" or frame.ardupilot)
        and (said is None or said in {number for number, _ in frame.ardupilot})
    ]


def _alike(one: Frame, other: Frame) -> bool:
    first, second = (
        np.stack([-frame.place[:, 1], frame.place[:, 0], frame.spin.astype(float)]) for frame in (one, other)
    )
    lengths = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    return bool(((first * second).sum(axis=1) >= _ALIKE * lengths).all())


# -- the flight ---------------------------------------------------------------------------------------------------


def _samples(flight: LogFlight, vehicle: Vehicle) -> Samples:
    """Thinned. Raises NotJudged."""
    samples = checked(flight.read(vehicle))
    return replace(samples, rows=thinned(samples.rows))


def _motion(flight: LogFlight, vehicle: Vehicle) -> tuple[Samples, Motion | None]:
    """Raises NotJudged."""
    samples = _samples(flight, vehicle)
    return samples, log_fit.motion_of(samples.rows, flight.fit(vehicle), samples.outputs_hz)


def _finished(flight: LogFlight, made: _Draft, samples: Samples, motion: Motion | None, notes: list[str]) -> Made:
    """With what the flight shows. Raises NotJudged where no vehicle flies like that."""
    thrusts = made.data.log is not None and made.data.log.unit == "N"
    if motion is None:
        if thrusts:
            raise NotJudged("too little flight to see what thrust carries the vehicle")
        how = "too little flight to learn anything of the vehicle: hover, inertia, lag guessed"
        return Made(made.vehicle, [*notes, how], samples)
    data = _hovering(made, motion)
    hover = Vehicle(data).hover
    if not _HOVER[0] <= hover <= _HOVER[1]:
        raise NotJudged(
            f"{samples.outputs}: outputs of {hover:.3f} of full thrust in flight, with which no vehicle hovers:"
            " are they the motors'?"
        )
    notes = [*notes, f"hovers at {hover:.3f} of full thrust, by the flight", f"arm {made.arm_m:.2f} m, a typical one"]
    found = log_fit.fit(flight.fit(Vehicle(data)), motion)
    data, learnt = _turning(data, found, made.arm_m)
    fault = fault_of(data)
    if fault is not None:
        raise NotJudged(f"the vehicle that this log tells of could not fly: {fault}")
    vehicle = Vehicle(data)
    if thrusts:  # fractions of another full thrust
        samples = _samples(flight, vehicle)
    return Made(vehicle, [*notes, learnt], samples)


def _hovering(made: _Draft, motion: Motion) -> AirframeFile:
    """With the thrust fraction of hover by the log; where it has thrusts, mass and full thrust are those."""
    data, motors = made.data, len(made.data.rotor)
    if data.log is None or data.log.unit != "N":
        thrust = data.airframe.mass_kg * GRAVITY_M_S2 / (motors * motion.hover)
        return msgspec.structs.replace(data, motor=msgspec.structs.replace(data.motor, max_thrust_n=thrust))
    full = motion.hover * _UNREAD_N / min(_HOVERS, motion.hover / max(motion.peak, 1e-9))
    mass = motion.hover * _UNREAD_N * motors / GRAVITY_M_S2
    ratio = mass / data.airframe.mass_kg
    inertia = tuple(ratio * value for value in data.airframe.inertia_kg_m2)
    airframe = msgspec.structs.replace(data.airframe, mass_kg=mass, inertia_kg_m2=inertia)
    motor = msgspec.structs.replace(data.motor, max_thrust_n=full)
    return msgspec.structs.replace(data, airframe=airframe, motor=motor)


def _turning(data: AirframeFile, found: Fit, arm_m: float) -> tuple[AirframeFile, str]:
    """With inertia, drag torque and lag by the log, of the axes that it tells of; and how."""
    told = found.explained >= _EXPLAINED_MIN
    gain = np.clip(found.gain, *_GAIN)
    told_names = [AXES[axis + 1] for axis in range(3) if told[axis]]
    if not told[:2].any():
        return data, "inertia, drag torque and lag guessed: the outputs in the log tell too little of the motion"
    roll, pitch = (gain[k] if told[k] else gain[1 - k] for k in range(2))
    before = data.airframe.inertia_kg_m2
    inertia = (
        before[0] / roll,
        before[1] / pitch,
        before[2] * (before[0] / roll + before[1] / pitch) / sum(before[:2]),
    )
    yaw = gain[2] if told[2] else 2.0 / (1.0 / roll + 1.0 / pitch)
    torque = data.motor.torque_per_thrust_m * yaw * inertia[2] / before[2]
    motor = msgspec.structs.replace(
        data.motor,
        torque_per_thrust_m=float(np.clip(torque, _DRAG_PER_ARM[0] * arm_m, _DRAG_PER_ARM[1] * arm_m)),
        time_constant_up_s=found.lag_s,
        time_constant_down_s=found.lag_s,
    )
    airframe = msgspec.structs.replace(data.airframe, inertia_kg_m2=tuple(map(float, inertia)))
    how = f"inertia and lag ({1e3 * found.lag_s:.0f} ms) by how the flight answers its outputs: {', '.join(told_names)}"
    return msgspec.structs.replace(data, airframe=airframe, motor=motor), how
