"""What ArduPilot's parameters say of the vehicle.

Sources: libraries/AP_Motors (AP_MotorsMatrix, AP_MotorsMulticopter, AP_Motors_Thrust_Linearization), SRV_Channel.
"""

from __future__ import annotations

from nff_companion.core.airframe_file import MOTORS_MAX
from nff_companion.frames import catalogue
from nff_companion.frames.catalogue import Frame
from nff_companion.frames.parameter_file import Parameters
from nff_companion.frames.reading import GUESSED, Known, Reading, hover, known
from nff_companion.frames.servo_functions import SERVOS, function_of

_CLASSES = {  # FRAME_CLASS that the companion has no model of
    0: "undefined",
    6: "a helicopter",
    7: "a tricopter, which steers with a servo",
    8: "a single rotor with flaps",
    9: "a coaxial rotor with flaps",
    10: "a tailsitter",
    11: "a helicopter with two rotors",
    13: "a helicopter with four rotors",
    16: "a frame of six degrees of freedom",
}
SCRIPTED = (15, 17)
_THROTTLE_CHANNEL = 3
_DEFAULT = f"{GUESSED}: ArduPilot's default"
_PULSES_US = {"MIN": 1000.0, "MAX": 2000.0}


def read(parameters: Parameters, frame: Frame | None) -> Reading:
    """``frame``: the owner's word. Raises ConfigError when the parameters contradict it, or neither says enough."""
    notes: list[str] = []
    found = frame_of(parameters, frame)
    _outputs(parameters, found, notes)
    return Reading(
        autopilot="ardupilot",
        title=f"{found.name} of ArduPilot",
        frame=found,
        place=found.place,
        spin=found.spin,
        thrust_expo=known(parameters, "MOT_THST_EXPO", "thrust_expo", Known(0.65, _DEFAULT)),
        spin_min=known(parameters, "MOT_SPIN_MIN", "spin_min", Known(0.15, _DEFAULT)),
        spin_max=known(parameters, "MOT_SPIN_MAX", "spin_max", Known(0.95, _DEFAULT)),
        pwm_min=_pulse(parameters, "MIN"),
        pwm_max=_pulse(parameters, "MAX"),
        gyro_filter_hz=known(parameters, "INS_GYRO_FILTER", "gyro_filter_hz", Known(20.0, _DEFAULT)),
        accelerometer_filter_hz=known(parameters, "INS_ACCEL_FILTER", "accelerometer_filter_hz", Known(20.0, _DEFAULT)),
        hover=hover(parameters, "MOT_THST_HOVER"),
        notes=notes,
    )


def defaults(frame: Frame) -> Reading:
    """The frame on a vehicle of which no parameter is known."""
    return read(Parameters({}, "no parameters"), frame)


def frame_of(parameters: Parameters, named: Frame | None) -> Frame:
    """By FRAME_CLASS and FRAME_TYPE, or ``named`` where they leave it open. Raises ConfigError when they contradict it,
    or neither says enough."""
    frame_class, frame_type = parameters.whole("FRAME_CLASS"), parameters.whole("FRAME_TYPE")
    if frame_class in SCRIPTED or frame_class is None:
        if named is None:
            said = "is missing" if frame_class is None else f"= {frame_class} is a frame made by a script"
            raise parameters.error(f"FRAME_CLASS {said}: give the frame by name")
        return named
    if frame_class in _CLASSES:
        raise parameters.error(f"FRAME_CLASS = {frame_class} is {_CLASSES[frame_class]}: there is no model of it")
    if frame_type is None:
        if named is not None and any(frame_class == known for known, _ in named.ardupilot):
            return named
        raise parameters.error(f"FRAME_TYPE is missing beside FRAME_CLASS = {frame_class}: give the frame by name")
    found = catalogue.of_ardupilot(frame_class, frame_type)
    if found is None:
        raise parameters.error(f"FRAME_CLASS = {frame_class} with FRAME_TYPE = {frame_type} is no frame of ArduPilot")
    if named is not None and named.name != found.name:
        raise parameters.error(
            f"FRAME_CLASS = {frame_class}, FRAME_TYPE = {frame_type} is {found.name}, and {named.name} was given:"
            " leave the name out, or set the parameters right"
        )
    return found


def _outputs(parameters: Parameters, frame: Frame, notes: list[str]) -> None:
    """Are the frame's motors on outputs, each on one? Which they are, where they are not in order, is a note."""
    motor_of = {function_of(motor): motor for motor in range(1, MOTORS_MAX + 1)}
    outputs: dict[int, int] = {}
    for output in range(1, SERVOS + 1):
        motor = motor_of.get(parameters.whole(f"SERVO{output}_FUNCTION") or 0)
        if motor is None:
            continue
        if motor in outputs:
            raise parameters.error(
                f"SERVO{output}_FUNCTION is motor {motor}, and so is SERVO{outputs[motor]}_FUNCTION: give each its own"
            )
        if motor > frame.motors:
            raise parameters.error(f"SERVO{output}_FUNCTION is motor {motor}, and {frame.name} has {frame.motors}")
        outputs[motor] = output
    missing = [motor for motor in range(1, frame.motors + 1) if motor not in outputs]
    if not parameters.values:
        return
    if not outputs:
        notes.append(f"No SERVOn_FUNCTION is a motor's: motors are taken to be on outputs 1 to {frame.motors}.")
    elif missing:
        raise parameters.error(f"motor {missing[0]} of {frame.name} has no output: no SERVOn_FUNCTION is its own")
    elif moved := [f"{motor} on {output}" for motor, output in sorted(outputs.items()) if motor != output]:
        notes.append(
            f"Motors are not on outputs 1 to {frame.motors} in order ({', '.join(moved)}): the companion will observe"
            " until each is on the output of its number."
        )


def _pulse(parameters: Parameters, end: str) -> Known:
    """MOT_PWM_MIN or MAX; 0, as older releases have it: the throttle channel's RCn_MIN or MAX."""
    name, key = f"MOT_PWM_{end}", f"pwm_{end.lower()}"
    if parameters.get(name) != 0.0:
        return known(parameters, name, key, Known(_PULSES_US[end], _DEFAULT))
    channel = parameters.whole("RCMAP_THROTTLE") or _THROTTLE_CHANNEL
    stick = f"RC{channel}_{end}"
    parameters.require(stick, f"{name} = 0 stands for it")
    value = known(parameters, stick, key, Known(_PULSES_US[end], _DEFAULT)).value
    return Known(value, f"{stick}, as {name} is 0")
