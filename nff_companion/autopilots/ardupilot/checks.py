"""Do the autopilot's parameters agree with the airframe? A wrong motor order names the wrong motor."""

from __future__ import annotations

from collections.abc import Mapping

from nff_companion.core.vehicle import Vehicle
from nff_companion.frames import catalogue
from nff_companion.frames.catalogue import Frame
from nff_companion.frames.comparison import contradictions_of_frame
from nff_companion.frames.servo_functions import SERVOS, function_of

FRAME_CLASS_SCRIPTED = 17
FRAME_BEFORE = "NFF_FRAME"  # of the applet: what was flown before its mixer, FRAME_CLASS times 100 plus FRAME_TYPE
_CLASS_FACTOR = 100
_THROTTLE = 3  # RCMAP_THROTTLE as it is shipped
_IGNORE_THRUST_LOSS = 1


def names(vehicle: Vehicle) -> list[str]:
    """Parameters that are looked at."""
    servos = [f"SERVO{n}_FUNCTION" for n in range(1, vehicle.motors + 1)]
    return [
        "FRAME_CLASS",
        "FRAME_TYPE",
        "MOT_THST_EXPO",
        "MOT_SPIN_MIN",
        "MOT_SPIN_MAX",
        "MOT_PWM_MIN",
        "MOT_PWM_MAX",
        "SCR_ENABLE",
        "FLIGHT_OPTIONS",
        "INS_GYRO_FILTER",
        "INS_ACCEL_FILTER",
        *servos,
    ]


def further(values: Mapping[str, float]) -> list[str]:
    """Parameters that must be known besides, by what others are: where the frame is the applet's, which it was before;
    where the motors' range is the throttle stick's, that."""
    out = [FRAME_BEFORE] if values.get("FRAME_CLASS") == FRAME_CLASS_SCRIPTED else []
    if not _range_unset(values):
        return out
    return [*out, *(_range_names(values) if "RCMAP_THROTTLE" in values else ["RCMAP_THROTTLE"])]


def frame_number(frame_class: int, frame_type: int) -> int:
    """What ``FRAME_BEFORE`` is for a frame."""
    return _CLASS_FACTOR * frame_class + frame_type


def frame_numbers(values: Mapping[str, float]) -> tuple[int, int | None] | None:
    """FRAME_CLASS and FRAME_TYPE (None: not said) of the frame that the firmware flies, or flew before the applet's
    mixer; None: not said."""
    frame_class, frame_type = values.get("FRAME_CLASS"), values.get("FRAME_TYPE")
    if frame_class == FRAME_CLASS_SCRIPTED:
        before = values.get(FRAME_BEFORE)
        return divmod(round(before), _CLASS_FACTOR) if before else None
    if frame_class is None:
        return None
    return round(frame_class), None if frame_type is None else round(frame_type)


def called(frame_class: int, frame_type: int, frame: Frame) -> str:
    """A frame of the firmware, for people."""
    return f"FRAME_CLASS {frame_class}, FRAME_TYPE {frame_type} ({frame.name})"


def compared_with(values: Mapping[str, float]) -> str:
    """The frame that the mixer was compared with when it was installed, for people; empty: it is not known."""
    frame_class, frame_type = frame_numbers(values) or (None, None)
    if frame_class is None or frame_type is None:
        return ""
    frame = catalogue.of_ardupilot(frame_class, frame_type)
    return "" if frame is None else called(frame_class, frame_type, frame)


def channel_of(values: Mapping[str, float], motor: int) -> int | None:
    """Servo output (from 1) that drives a motor (from 1); None: none does."""
    wanted = function_of(motor)
    return next((n for n in range(1, SERVOS + 1) if values.get(f"SERVO{n}_FUNCTION") == wanted), None)


def contradictions(values: Mapping[str, float], vehicle: Vehicle) -> list[str]:
    """What would make the companion misread the vehicle, in words; nothing may be sent while there is any."""
    out: list[str] = []
    for motor in range(1, vehicle.motors + 1):
        function = values.get(f"SERVO{motor}_FUNCTION")
        if function is not None and function != function_of(motor):
            out.append(f"SERVO{motor}_FUNCTION is {function:.0f}, motor {motor} needs {function_of(motor)}")
    return misfits(values, vehicle) + out


def misfits(values: Mapping[str, float], vehicle: Vehicle) -> list[str]:
    """What of these parameters is not so of this airframe, wherever its motors are connected."""
    out: list[str] = []
    command, numbers = vehicle.command, frame_numbers(values)
    if numbers is not None:
        out += _of_frame(*numbers, vehicle)
    if values.get("FRAME_CLASS") in (None, FRAME_CLASS_SCRIPTED):
        more = channel_of(values, vehicle.motors + 1)  # of a frame that is known it is a leftover
        if more is not None:
            text = f"SERVO{more}_FUNCTION drives motor {vehicle.motors + 1}"
            out.append(f"{text}, the airframe has {vehicle.motors} motors")
    expected = {
        "MOT_THST_EXPO": (command.thrust_expo, 0.02),
        "MOT_SPIN_MIN": (command.spin_min, 0.005),
        "MOT_SPIN_MAX": (command.spin_max, 0.005),
        "MOT_PWM_MIN": (command.pwm_min, 0.5),
        "MOT_PWM_MAX": (command.pwm_max, 0.5),
    }
    if _range_unset(values):
        del expected["MOT_PWM_MIN"], expected["MOT_PWM_MAX"]
        low, high = _range_names(values)
        # A stick is calibrated to a few microseconds: a hundredth of the range.
        tolerance = 0.01 * (command.pwm_max - command.pwm_min)
        expected |= {low: (command.pwm_min, tolerance), high: (command.pwm_max, tolerance)}
    for name, (wanted, tolerance) in expected.items():
        value = values.get(name)
        if value is not None and abs(value - wanted) > tolerance:
            out.append(f"{name} is {value:g}, the airframe file says {wanted:g}")
    return out


def _of_frame(frame_class: int, frame_type: int | None, vehicle: Vehicle) -> list[str]:
    """What of the frame that the firmware flies is not so of the airframe."""
    if catalogue.motors_of_ardupilot(frame_class) != vehicle.motors:
        return [f"FRAME_CLASS is {frame_class}, the airframe has {vehicle.motors} motors"]
    if frame_type is None:
        return []
    frame = catalogue.of_ardupilot(frame_class, frame_type)
    if frame is None:
        return [f"FRAME_CLASS {frame_class} with FRAME_TYPE {frame_type} is no frame that is known here"]
    return contradictions_of_frame(vehicle, frame, called(frame_class, frame_type, frame))


def _range_unset(values: Mapping[str, float]) -> bool:
    """0: the motors have the range of the throttle stick (before ArduCopter 4.2, which copies it)."""
    return values.get("MOT_PWM_MIN") == 0.0 or values.get("MOT_PWM_MAX") == 0.0


def _range_names(values: Mapping[str, float]) -> list[str]:
    channel = round(values.get("RCMAP_THROTTLE", _THROTTLE))
    return [f"RC{channel}_MIN", f"RC{channel}_MAX"]


def advice(values: Mapping[str, float], vehicle: Vehicle) -> list[str]:
    """What should be changed before a flight, but does not mislead the companion."""
    out: list[str] = []
    if values.get("SCR_ENABLE") != 1.0:
        out.append("SCR_ENABLE is not 1: the applet does not run")
    if values.get("FRAME_CLASS") == FRAME_CLASS_SCRIPTED:
        if not int(values.get("FLIGHT_OPTIONS", 0.0)) & _IGNORE_THRUST_LOSS:
            out.append("FLIGHT_OPTIONS bit 0 is not set: a reallocated vehicle may trip the thrust-loss check")
    else:
        out.append("FRAME_CLASS is not 17: no matrix can be loaded, only override mode acts")
    return out
