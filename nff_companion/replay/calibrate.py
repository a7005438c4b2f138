"""``nff calibrate``: an airframe file from logs of healthy flight."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from nff_companion.calibration import airframe, chain, excitation, model, order
from nff_companion.calibration import fit as fitting
from nff_companion.calibration.airframe import Number
from nff_companion.calibration.excitation import Verdict
from nff_companion.calibration.fit import Course, Fit
from nff_companion.calibration.order import Weighed
from nff_companion.calibration.record import PIECE_MIN_S, Piece, Record, record
from nff_companion.core import toml_file
from nff_companion.core import vehicle as vehicles
from nff_companion.core.airframe_file import AirframeFile
from nff_companion.core.motor_order import Order
from nff_companion.core.tuning import DEFAULT
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import ConfigError, NotJudged
from nff_companion.frames import draft
from nff_companion.frames.draft import Size
from nff_companion.replay import airframe_of_log
from nff_companion.replay.flight import LogFlight
from nff_companion.replay.judge import judge
from nff_companion.replay.run import flights, rate_of, reading
from nff_companion.replay.thinning import thinned

_LEAST_S, _MOST_S = 20.0, 600.0  # of flight
_BEGINNING = 0.3
_LAG_MIN_S = 1e-3
_RATE_HZ, _RATE_MIN_HZ = 200.0, 45.0  # more tells nothing, with less the motors' lag does not show
_OUTPUTS_MIN_HZ = 45.0
# Mean squares of the shares' difference (order.py): another order is named when it fits, and the file's does not.
_FITS, _CLEARLY = 0.45, 0.08
# Parameters that the link compares with the file's: with another curve than the autopilot's own nothing would fly.
_CURVE_TOLD = {"thrust_expo": ("MOT_THST_EXPO", "THR_MDL_FAC"), "spin_min": ("MOT_SPIN_MIN",)}


class TooShort(NotJudged):
    """More flight is needed."""


class OtherOrder(NotJudged):
    """The motors are in another ``order`` than the file has them."""

    def __init__(self, message: str, order: Order) -> None:
        super().__init__(message)
        self.order = order


@dataclass(frozen=True)
class Start:
    """What is calibrated: ``airframe`` a file or shipped name; without one, ``frame`` of the catalogue or what the log
    says, and what the owner measured."""

    airframe: str = ""
    frame: str = ""
    size: Size | None = None


@dataclass(frozen=True)
class Calibration:
    """``text`` of the new airframe file, ``flown_s`` of flight it was made of."""

    text: str
    numbers: list[Number]
    verdicts: list[Verdict]
    order: Weighed
    fit: Fit
    course: Course
    flown_s: float


def calibrate(paths: Sequence[Path], start: Start, name: str) -> Calibration:
    """The airframe called ``name`` from all flights in ``paths``, whose logs are one vehicle's. Raises LogError,
    NotJudged with what the logs lack, ConfigError."""
    found = [flight for path in paths for flight in flights(path)]
    return of_flights(found, *_start(found[0], start), name)


def of_flights(found: list[LogFlight], text: str, vehicle: Vehicle, name: str) -> Calibration:
    """The same from flights that were read, and the file ``text`` of ``vehicle`` to begin with. Raises as that does:
    TooShort and OtherOrder too."""
    vehicle = found[0].fit(vehicle)
    pieces = []
    for flight in found:
        read = reading(flight, vehicle)
        if read.outputs_hz < _OUTPUTS_MIN_HZ:
            raise NotJudged(
                f"{flight.name}: {read.outputs} at {read.outputs_hz:.0f} Hz; motor outputs at"
                f" {_OUTPUTS_MIN_HZ:.0f} Hz or more show how the vehicle answers them"
            )
        rows = thinned(read.rows, _RATE_HZ)
        rate_hz = rate_of(sample for _, sample in rows)
        if rate_hz < _RATE_MIN_HZ:
            raise NotJudged(f"{flight.name}: inertial samples at {rate_hz:.0f} Hz; {_RATE_MIN_HZ:.0f} Hz are needed")
        pieces += record([sample for _, sample in rows], battery=read.battery).pieces
    whole = _shortened(Record(pieces), _MOST_S)  # more adds time, and little else
    if whole.duration_s < _LEAST_S:
        raise TooShort(f"{whole.duration_s:.0f} s of flight without gaps; {_LEAST_S:.0f} s or more are needed")
    return _calibrated(found, whole, vehicle, text, name)


def _start(flight: LogFlight, start: Start) -> tuple[str, Vehicle]:
    """The file to begin with, and its vehicle. Raises ConfigError, NotJudged."""
    if start.airframe:
        return vehicles.path_of(start.airframe).read_text(encoding="utf-8"), vehicles.load(start.airframe)
    size = start.size or Size(airframe_of_log.ARM_M)
    text = airframe_of_log.draft_text(flight, start.frame or None, size)
    return text, Vehicle(toml_file.converted(tomllib.loads(text), AirframeFile, flight.path, "airframe"))


def _shortened(whole: Record, most_s: float) -> Record:
    """The first ``most_s`` of it."""
    pieces, left_s = list[Piece](), most_s
    for piece in whole.pieces:
        if left_s < PIECE_MIN_S:
            break
        pieces.append(piece.first(left_s))
        left_s -= piece.samples * piece.dt_s
    return Record(pieces)


def _calibrated(found: list[LogFlight], whole: Record, vehicle: Vehicle, text: str, name: str) -> Calibration:
    jx, jy, jz = vehicle.inertia_kg_m2.tolist()
    inertia, layout = (jx, jy, jz), model.Layout.of(vehicle)
    filters = chain.Filters(
        vehicle.telemetry.gyro_filter_hz, vehicle.telemetry.accelerometer_filter_hz, DEFAULT.residual.smoothing_s
    )
    # With its beginning alone first: what fails later has not spoilt the vehicle that it is judged with. Its yaw may be
    # wrong, and then it is the whole flight's vehicle that says whether anything failed at all.
    prior = _known(found)
    beginning = _shortened(whole, max(_BEGINNING * whole.duration_s, 0.5 * _LEAST_S))
    start = _start_of(vehicle)
    shares = order.shares(whole, layout, filters, model.shape_of(start, layout.full), inertia)
    _ordered(order.weigh(shares, layout), vehicle)
    prior = prior if shares.turned else replace(prior, yaw=0.0)
    begin = fitting.fit(beginning, layout, filters, inertia, start, replace(prior, yaw=0.0), rounds=2)
    suspected = _failure(found, _file(found, vehicle, begin, text, name)[1])
    fit = fitting.fit(whole, layout, filters, inertia, start, prior)
    weighed = order.weigh(order.shares(whole, layout, filters, model.shape_of(fit.x, layout.full), inertia), layout)
    _ordered(weighed, vehicle)
    if suspected and not fit.prior[model.motors_of(layout)].any():
        raise NotJudged(suspected)  # motors as no vehicle has them, and a failure that the flight's beginning shows
    try:
        written, made = _file(found, vehicle, fit, text, name)
    except NotJudged as error:
        raise NotJudged(suspected or str(error)) from error
    failed = _failure(found, made)
    if failed:
        raise NotJudged(suspected or failed)
    course = fitting.course(whole, layout, filters, inertia, fit.x)
    verdicts = [verdict for verdict in excitation.verdicts(fit) if verdict.deviation > 0.0]
    return Calibration(written, numbers(vehicle, fit), verdicts, weighed, fit, course, whole.duration_s)


def _known(found: list[LogFlight]) -> model.Prior:
    """What is known beforehand: a thrust curve that the autopilot was told is that of the file, as it stands."""
    told = {name for flight in found for name in flight.parameters.at(flight.take_off_s)}
    prior = model.Prior()
    if told.intersection(_CURVE_TOLD["thrust_expo"]):
        prior = replace(prior, expo=0.0)
    if told.intersection(_CURVE_TOLD["spin_min"]):
        prior = replace(prior, idle=0.0)
    return prior


def numbers(vehicle: Vehicle, fit: Fit) -> list[Number]:
    """Those that were measured."""
    return [number for number in airframe.numbers(vehicle, fit) if number.deviation > 0.0]


def _start_of(vehicle: Vehicle) -> NDArray[np.float64]:
    motor, command = vehicle.motor, vehicle.command
    lag_s = max(0.5 * (motor.time_constant_up_s + motor.time_constant_down_s), _LAG_MIN_S)
    delay_s = vehicle.telemetry.output_delay_s
    return model.start(model.Layout.of(vehicle), lag_s, command.thrust_expo, command.spin_min, delay_s)


def _ordered(weighed: Weighed, vehicle: Vehicle) -> None:
    """Raises NotJudged."""
    if weighed.off < _FITS and weighed.off_file - weighed.off > _CLEARLY:
        raise OtherOrder(
            f"{weighed.best.text} against airframe {vehicle.name}: the autopilot gives its motors other shares of roll,"
            " pitch and yaw; correct the frame, or the numbers and spins of [[rotor]]",
            weighed.best,
        )


def _file(found: list[LogFlight], vehicle: Vehicle, fit: Fit, text: str, name: str) -> tuple[str, Vehicle]:
    """The new airframe file. Raises NotJudged where no vehicle is like that."""
    source = f"calibrated from {', '.join(flight.path.name for flight in found)}"[:1000]
    written = airframe.written(text, numbers(vehicle, fit), name, source)
    try:
        draft.check(written, Path(f"{name}.toml"))
    except ConfigError as error:
        raise NotJudged(
            f"no vehicle flies like this: {error}; does a motor fail in it, is it of another frame, or are the outputs"
            " not the motors'?"
        ) from error
    return written, Vehicle(msgspec.convert(tomllib.loads(written), AirframeFile))


def _failure(found: list[LogFlight], vehicle: Vehicle) -> str:
    """Which motor fails in a flight, in words: nothing can be learnt of a vehicle that is not whole; empty: none."""
    for flight in found:
        fitted = flight.fit(vehicle)
        read = reading(flight, fitted)
        rows = thinned(read.rows)
        rate_hz = rate_of(sample for _, sample in rows)
        said = judge(fitted, rows, rate_hz, flight.first_s, read.outputs, read.outputs_hz)
        if said.verdict == "fault":
            fault = said.faults[0]
            return (
                f"{flight.name}: motor {fault.motor} fails {fault.time_s:.1f} s into the log; calibrate from healthy"
                " flight"
            )
    return ""
