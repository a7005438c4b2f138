"""Do the autopilot's parameters agree with the airframe? A wrong motor order names the wrong motor."""

from __future__ import annotations

from collections.abc import Mapping

from nff_companion.core.vehicle import Vehicle

FRAME_CLASS_SCRIPTED = 17
_FRAME_CLASSES = {4: (1,), 6: (2, 5, 13), 8: (3, 4), 10: (14,), 12: (12, 15)}
_FIRST_FUNCTION, _NINTH_FUNCTION = 33, 82
SERVOS = 32
_THROTTLE = 3  # RCMAP_THROTTLE as it is shipped
_IGNORE_THRUST_LOSS = 1


def function_of(motor: int) -> int:
    """SERVOn_FUNCTION of a motor (from 1)."""
    return _FIRST_FUNCTION + motor - 1 if motor <= 8 else _NINTH_FUNCTION + motor - 9


def names(vehicle: Vehicle) -> list[str]:
    """Parameters that are looked at."""
    servos = [f"SERVO{n}_FUNCTION" for n in range(1, vehicle.motors + 1)]
    return [
        "FRAME_CLASS",
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
    """Parameters that must be known besides, by what others are: where the motors' range is the throttle stick's."""
    if not _range_unset(values):
        return []
    channel = values.get("RCMAP_THROTTLE")
    return ["RCMAP_THROTTLE"] if channel is None else _range_names(values)


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
    command, frame_class = vehicle.command, values.get("FRAME_CLASS")
    fitting = _FRAME_CLASSES.get(vehicle.motors, ())
    if frame_class is not None and frame_class != FRAME_CLASS_SCRIPTED:
        if fitting and frame_class not in fitting:
            out.append(f"FRAME_CLASS is {frame_class:.0f}, the airframe has {vehicle.motors} motors")
    else:
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
