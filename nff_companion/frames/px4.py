"""What PX4's parameters say of the vehicle.

Sources: src/modules/control_allocator/module.yaml, src/drivers/pwm_out/module.yaml, src/lib/mixer_module of v1.16.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.airframe_file import MOTORS_MAX, MOTORS_MIN
from nff_companion.frames import catalogue
from nff_companion.frames.catalogue import Frame
from nff_companion.frames.parameter_file import Parameters
from nff_companion.frames.reading import GUESSED, Known, Reading, hover, known

_MULTIROTOR = 0  # CA_AIRFRAME
_FIRST_MOTOR = 101  # of PWM_MAIN_FUNCn
_OUTPUTS, _GROUPS = 16, 4
_PULSES_US = {"MIN": 1000.0, "MAX": 2000.0}
_DEFAULT = f"{GUESSED}: PX4's default"
_DRAG_DEFAULT = 0.05  # |CA_ROTORn_KM| that nobody has set
_LARGEST = 100.0  # of a CA_ROTORn_*
_UPRIGHT = (0.0, 0.0, -1.0)
_TOLERANCE = 1e-3


def read(parameters: Parameters, frame: Frame | None) -> Reading:
    """``frame``: the owner's word. Raises ConfigError when the parameters contradict it, or neither says enough."""
    notes: list[str] = []
    place, spin, drag = _geometry(parameters, frame)
    found = frame if frame is not None and _same(frame, place, spin) else catalogue.alike(place, spin)
    if frame is not None and found is not frame:
        which = "another one" if found is None else found.name
        raise parameters.error(f"CA_ROTORn_* are those of {which}, and {frame.name} was given: leave the name out")
    pulses = _pulses(parameters, len(spin), notes)
    exact = "HIGHRES_IMU is made of integrated samples, in front of PX4's filters"
    return Reading(
        autopilot="px4",
        title="a frame of your own on PX4" if found is None else f"{found.name} of PX4",
        frame=found,
        place=catalogue.scaled(place),
        spin=spin,
        thrust_expo=known(parameters, "THR_MDL_FAC", "thrust_expo", Known(0.0, _DEFAULT)),
        spin_min=Known(0.0, "PX4 drives outputs over their whole range"),
        spin_max=Known(1.0, "PX4 drives outputs over their whole range"),
        pwm_min=pulses["MIN"],
        pwm_max=pulses["MAX"],
        gyro_filter_hz=Known(0.0, exact),
        accelerometer_filter_hz=Known(0.0, exact),
        hover=hover(parameters, "MPC_THR_HOVER"),
        drag_per_arm=drag,
        notes=notes,
    )


def defaults(frame: Frame) -> Reading:
    """The frame on a vehicle of which no parameter is known."""
    return read(Parameters({}, "no parameters"), frame)


def _same(frame: Frame, place: NDArray[np.float64], spin: NDArray[np.float64]) -> bool:
    if frame.motors != len(spin) or (frame.spin != spin).any():
        return False
    return bool(np.allclose(frame.place, catalogue.scaled(place), atol=0.03))


def _geometry(
    parameters: Parameters, named: Frame | None
) -> tuple[NDArray[np.float64], NDArray[np.float64], Known | None]:
    """Places (m, 2) of any scale, spins (m,), and drag over the farthest arm where somebody has set one."""
    kind = parameters.whole("CA_AIRFRAME")
    if kind not in (None, _MULTIROTOR):
        raise parameters.error(f"CA_AIRFRAME = {kind} is no multirotor (0): there is no model of it")
    if not any(name.startswith("CA_ROTOR") and name.endswith(("_PX", "_PY")) for name in parameters.values):
        frame = named or _of_autostart(parameters)
        return frame.place, frame.spin, None
    parameters.require("CA_ROTOR_COUNT", "save all parameters, or give the frame by name alone")
    count = parameters.whole("CA_ROTOR_COUNT") or 0
    if not MOTORS_MIN <= count <= MOTORS_MAX:
        raise parameters.error(f"CA_ROTOR_COUNT = {count}: between {MOTORS_MIN} and {MOTORS_MAX} can be handled")
    if parameters.whole("CA_R_REV"):
        raise parameters.error("CA_R_REV: motors that turn both ways have no model here; give 0")
    rows = np.array([_rotor(parameters, index) for index in range(count)])
    place, drag, thrust = rows[:, :2], rows[:, 2], rows[:, 3]
    if np.ptp(thrust) > _TOLERANCE * thrust.max():
        raise parameters.error("CA_ROTORn_CT differ: rotors of one kind have a model here; was a journal lost?")
    arm = float(np.hypot(*place.T).max())
    if arm < _TOLERANCE:
        raise parameters.error("CA_ROTORn_PX, PY are all 0: give the motors their places")
    size = np.abs(drag)
    set_by_somebody = np.ptp(size) < _TOLERANCE and abs(size[0] - _DRAG_DEFAULT) > _TOLERANCE
    origin = (
        Known(float(size.mean()) / arm, "CA_ROTORn_KM over the arm that CA_ROTORn_PX, PY give")
        if set_by_somebody
        else None
    )
    return place, np.sign(drag), origin


def _of_autostart(parameters: Parameters) -> Frame:
    autostart = parameters.whole("SYS_AUTOSTART")
    if autostart is None:
        raise parameters.error("CA_ROTORn_* and SYS_AUTOSTART are missing: give the frame by name")
    frame = catalogue.of_px4(autostart)
    if frame is None:
        raise parameters.error(
            f"SYS_AUTOSTART = {autostart} is not known: save all parameters, or give the frame by name"
        )
    return frame


def _rotor(parameters: Parameters, index: int) -> tuple[float, float, float, float]:
    """Place, drag (+ ccw) and thrust coefficient of a rotor, from 0.

    Place and drag must be there: in a file of changed parameters alone, what is missing is the airframe's, not 0.
    """
    prefix = f"CA_ROTOR{index}_"
    why = f"of motor {index + 1}; save all parameters, not the changed ones alone, or give the frame by name alone"
    for name in ("PX", "PY", "KM", "AX", "AY", "AZ", "CT"):
        value = parameters.get(prefix + name)
        if value is not None and abs(value) > _LARGEST:
            raise parameters.error(f"{prefix}{name} = {value:g}: PX4 takes at most {_LARGEST:g}")
    x, y, drag = (parameters.require(prefix + name, why) for name in ("PX", "PY", "KM"))
    axis = [parameters.get(prefix + name) for name in ("AX", "AY", "AZ")]
    direction = np.array([default if value is None else value for value, default in zip(axis, _UPRIGHT, strict=True)])
    length = float(np.linalg.norm(direction))
    if length == 0.0 or float(np.abs(direction / length - _UPRIGHT).max()) > _TOLERANCE:
        raise parameters.error(
            f"{prefix}AX, AY, AZ: motor {index + 1} is not upright (0, 0, -1): there is no model of it"
        )
    if parameters.whole(prefix + "TILT"):
        raise parameters.error(f"{prefix}TILT: motor {index + 1} is tilted by a servo: there is no model of it")
    if drag == 0.0:
        raise parameters.error(f"{prefix}KM = 0: give motor {index + 1} its spin, positive for ccw")
    thrust = parameters.get(prefix + "CT")
    if thrust is not None and thrust <= 0.0:
        raise parameters.error(f"{prefix}CT = {thrust:g}: a motor without thrust; was a journal lost?")
    return x, y, drag, 6.5 if thrust is None else thrust


def _pulses(parameters: Parameters, motors: int, notes: list[str]) -> dict[str, Known]:
    """Pulse widths, one range for all motors. Raises ConfigError when they differ."""
    bank = next((b for b in ("MAIN", "AUX") if _outputs(parameters, b)), None)
    if bank is None:
        if parameters.values:
            notes.append(f"No PWM_MAIN_FUNCn is a motor's: motors are taken to be on outputs 1 to {motors}.")
        return {end: Known(value, _DEFAULT) for end, value in _PULSES_US.items()}
    outputs = _outputs(parameters, bank)
    for motor in range(1, motors + 1):
        if motor not in outputs:
            raise parameters.error(f"motor {motor} has no output: no PWM_{bank}_FUNCn is {_FIRST_MOTOR - 1 + motor}")
    moved = [f"{motor} on {output}" for motor, output in sorted(outputs.items()) if motor != output]
    if bank != "MAIN" or moved:
        where = f" ({', '.join(moved)})" if moved else ""
        notes.append(
            f"Motors are on outputs PWM_{bank}{where}: the companion wants motor n on PWM_MAIN n, and will observe."
        )
    if any((parameters.get(f"PWM_{bank}_TIM{group}") or 0.0) < 0.0 for group in range(_GROUPS)):
        notes.append(
            f"PWM_{bank}_TIMn is DShot or OneShot: such outputs are not understood, the companion will observe."
        )
    out: dict[str, Known] = {}
    for end, default in _PULSES_US.items():
        otherwise = Known(default, _DEFAULT)
        names = [f"PWM_{bank}_{end}{output}" for motor, output in sorted(outputs.items()) if motor <= motors]
        widths = {name: known(parameters, name, f"pwm_{end.lower()}", otherwise).value for name in names}
        if len(set(widths.values())) > 1:
            low, high = (choose(widths, key=widths.__getitem__) for choose in (min, max))
            raise parameters.error(f"{low} = {widths[low]:g} and {high} = {widths[high]:g}: give all motors the same")
        out[end] = Known(widths[names[0]], f"PWM_{bank}_{end}n") if names[0] in parameters else otherwise
    return out


def _outputs(parameters: Parameters, bank: str) -> dict[int, int]:
    """Output by motor. Raises ConfigError when two are one motor's."""
    out: dict[int, int] = {}
    for output in range(1, _OUTPUTS + 1):
        motor = (parameters.whole(f"PWM_{bank}_FUNC{output}") or 0) - _FIRST_MOTOR + 1
        if not 1 <= motor <= MOTORS_MAX:
            continue
        if motor in out:
            raise parameters.error(f"PWM_{bank}_FUNC{output} is motor {motor}, and so is PWM_{bank}_FUNC{out[motor]}")
        out[motor] = output
    return out
