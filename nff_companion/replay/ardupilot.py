"""What ArduPilot's parameters say of a flight, the same for its own logs and for telemetry."""

from __future__ import annotations

from collections.abc import Mapping

from nff_companion.autopilots.ardupilot import checks
from nff_companion.core.vehicle import TelemetryTable, Vehicle
from nff_companion.errors import NotJudged
from nff_companion.frames.servo_functions import function_of
from nff_companion.replay.flight import Frame

# AP_Motors: FRAME_CLASS and how many motors it has; FRAME_TYPE.
_CLASSES = {
    1: ("quad", 4),
    2: ("hexa", 6),
    3: ("octa", 8),
    4: ("octa-quad", 8),
    5: ("Y6", 6),
    12: ("dodeca-hexa", 12),
    14: ("deca", 10),
}
_MOTORS_MAX = 12
_TYPES = {0: "plus", 1: "X", 2: "V", 3: "H"}


def frame_of(values: Mapping[str, float]) -> Frame | None:
    """By FRAME_CLASS, else by the motors that outputs are assigned to; None: parameters do not say."""
    number, kind = values.get("FRAME_CLASS"), values.get("FRAME_TYPE")
    if number is None:
        last = max((motor for motor in range(1, _MOTORS_MAX + 1) if checks.channel_of(values, motor)), default=0)
        return Frame(f"{last} motors by SERVOn_FUNCTION", last) if last else None
    name, motors = _CLASSES.get(int(number), ("frame", None))
    text = f"{name} {_TYPES.get(-1 if kind is None else int(kind), '')}".strip() + f" (FRAME_CLASS {number:.0f}"
    text += ")" if kind is None else f", FRAME_TYPE {kind:.0f})"
    return Frame(text, motors, int(number), None if kind is None else int(kind))


def fitted(vehicle: Vehicle, values: Mapping[str, float]) -> Vehicle:
    """The airframe behind the autopilot's own filters, as on the live link."""
    if "INS_GYRO_FILTER" not in values or "INS_ACCEL_FILTER" not in values:
        return vehicle
    return vehicle.with_telemetry(TelemetryTable(values["INS_GYRO_FILTER"], values["INS_ACCEL_FILTER"]))


def channels(values: Mapping[str, float], motors: int, outputs: int) -> list[int] | None:
    """Output (from 0) of each motor, of so many ``outputs`` that are logged; None: the parameters do not say. Raises
    NotJudged where they say that a motor has none."""
    found = [checks.channel_of(values, motor) for motor in range(1, motors + 1)]
    if None not in found and max(channel for channel in found if channel is not None) <= outputs:
        return [channel - 1 for channel in found if channel is not None]
    for motor, channel in enumerate(found, start=1):
        if channel is not None and channel > outputs:
            raise NotJudged(f"motor {motor} is on output {channel}: {outputs} are logged")
        if channel is None and f"SERVO{motor}_FUNCTION" in values:
            raise NotJudged(f"no SERVOn_FUNCTION is {function_of(motor)}, motor {motor}: another airframe?")
    for motor, channel in enumerate(found, start=1):
        if channel not in (None, motor):
            raise NotJudged(f"motor {motor} is on output {channel}, and where all others are is not in the log")
    return None


def misfit(values: Mapping[str, float], vehicle: Vehicle, frame: Frame | None) -> str:
    """What contradicts the airframe, by the live link's own checks; empty when nothing does."""
    wrong = checks.misfits(values, vehicle)
    if not wrong and frame is not None and frame.motors not in (None, vehicle.motors):
        wrong = [f"the log is of {frame.text}, the airframe has {vehicle.motors} motors"]
    return "; ".join(wrong)
