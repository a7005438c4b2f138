"""An airframe file of what is known of a vehicle, and guesses for the rest, each marked as one.

The guesses are scaled from vehicles that fly: propellers as large as the frame has room for, 7.5 kg for each m^2 that
they sweep, three tenths of the mass at the motors (the inertia of the X500, 2 kg, within 5 %; of the shipped
airframes within a factor of two). Thrust and inertia go with the mass, so that an error of the mass alone moves no
acceleration: what matters is the thrust that hovers, and the arm.
"""

from __future__ import annotations

import math
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nff_companion.core import toml_file
from nff_companion.core.airframe_file import GRAVITY_M_S2, AirframeFile, AirframeTable, fault_of
from nff_companion.core.rotors import RotorTable
from nff_companion.core.tuning.span import fields, shown
from nff_companion.errors import ConfigError
from nff_companion.frames.catalogue import SPIN_NAMES, Frame
from nff_companion.frames.reading import GUESSED, Known, Reading

_RADIUS_PER_GAP, _RADIUS_PER_ARM = 0.48, 0.5  # of propellers: no room for more; more than is usual
_SWEPT_KG_M2 = 7.5
_SECOND_ROTOR = 0.5  # what the second of a coaxial pair adds to the area
_AT_MOTORS = 0.3  # share of the mass; the rest is a cylinder as below, over the arm
_BODY_RADIUS, _BODY_HEIGHT = 0.3, 0.3
_HOVER = 0.4  # thrust fraction
_DRAG_PER_RADIUS = 0.1
# octo-x, which the plant's own numbers are scaled from
_ARM_M, _RADIUS_M, _LAG_S, _TIP_M_S = 0.5, 0.19, 0.045, 133.0


@dataclass(frozen=True, slots=True)
class Size:
    """What the owner measured; None: not."""

    arm_m: float  # of the farthest motor
    mass_kg: float | None = None

    def check(self) -> None:
        """Raises ConfigError out of the ranges of an airframe file."""
        spans = {field.path[-1]: field for table in (AirframeTable, RotorTable) for field in fields(table)}
        for key, value in (("arm_m", self.arm_m), ("mass_kg", self.mass_kg)):
            if value is not None and not spans[key].admits(value):
                raise ConfigError(f"--{key.split('_')[0]} {shown(value)} is not allowed: give {spans[key].allowed}")


@dataclass(frozen=True, slots=True)
class Draft:
    """Text of the file, and the dotted keys of what is guessed in it."""

    text: str
    guessed: list[str]


class _Lines:
    """Lines of the file, each number with who says so."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.guessed: list[str] = []
        self._table = ""

    def table(self, name: str, *comments: str) -> None:
        self._table = name
        self.lines += ["", f"[{name}]", *(f"# {comment}" for comment in comments)]

    def put(self, key: str, value: Known) -> None:
        self._put(key, _number(value.value), value)

    def put_list(self, key: str, values: list[float], origin: str) -> None:
        self._put(key, f"[{', '.join(map(_number, values))}]", Known(0.0, origin))

    def _put(self, key: str, text: str, value: Known) -> None:
        self.lines.append(f"{key} = {text}  # {value.origin}")
        if value.guessed:
            self.guessed.append(f"{self._table}.{key}")


def draft(reading: Reading, size: Size, name: str, source: str) -> Draft:
    """The file called ``name``. Raises ConfigError when no model can be made of the frame, or none that could fly."""
    _check_frame(reading.frame)
    size.check()
    radius_m = _radius(reading, size.arm_m)
    mass = Known(_mass(reading, radius_m), GUESSED) if size.mass_kg is None else Known(size.mass_kg, "as given")
    lines = _Lines()
    lines.lines += [
        f"# {_printable(reading.title)}. Made by `nff airframe new`: what is marked as guessed was not measured.",
        "# Frame: FRD body; angles clockwise from the nose; motors numbered from 1 in the order of [[rotor]].",
        "[airframe]",
        f'name = "{_printable(name)}"',
        f'source = "{_printable(source)}"',
    ]
    lines._table = "airframe"
    lines.put("mass_kg", mass)
    inertia = [mass.value * size.arm_m**2 * share for share in _inertia(reading)]
    lines.put_list("inertia_kg_m2", inertia, f"{GUESSED}; roll, pitch, yaw (principal axes)")
    _motor(lines, reading, size, mass, radius_m)
    lines.table("command", "thrust fraction = (1 - expo) c + expo c^2, c = (output - spin_min) / (spin_max - spin_min)")
    for key in ("thrust_expo", "spin_min", "spin_max", "pwm_min", "pwm_max"):
        lines.put(key, getattr(reading, key))
    lines.table("telemetry", "second-order low-passes of the autopilot on what it sends, in Hz; 0: none")
    for key in ("gyro_filter_hz", "accelerometer_filter_hz"):
        lines.put(key, getattr(reading, key))
    _aerodynamics(lines, size.arm_m, radius_m)
    _rotors(lines, reading, size.arm_m)
    return Draft("\n".join(lines.lines) + "\n", [key for key in lines.guessed if not key.startswith("aerodynamics.")])


def check(text: str, path: Path) -> None:
    """Raises ConfigError when ``text`` would be refused as the airframe file ``path``."""
    what = "airframe file"
    fault = fault_of(toml_file.converted(tomllib.loads(text), AirframeFile, path, what))
    if fault is not None:
        raise ConfigError(f"{what} {path}: {fault}")


def write(text: str, path: Path) -> None:
    """A new file; none is ever replaced. Raises ConfigError."""
    check(text, path)
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError as error:
        raise ConfigError(f"{path} exists already: give another name, or remove it") from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be written: {getattr(error, 'strerror', None) or error}") from error


def _check_frame(frame: Frame | None) -> None:
    if frame is not None and frame.without:
        raise ConfigError(f"of frame {frame.name} there is no model: {frame.without}")


def _number(value: float) -> str:
    return f"{value:.5g}"


def _printable(text: str) -> str:
    """As a TOML string or comment takes it, whatever a file is called."""
    return re.sub(r"[^ !#-\[\]-~]", "?", text)[:200]


def _radius(reading: Reading, arm_m: float) -> float:
    """Of the propellers that there is room for, m."""
    place = reading.place
    gaps = np.hypot(*(place[:, None] - place[None]).T)
    apart = gaps[gaps > 0.01]
    gap = float(apart.min()) if apart.size else 1.0
    return arm_m * min(_RADIUS_PER_GAP * gap, _RADIUS_PER_ARM)


def _mass(reading: Reading, radius_m: float) -> float:
    sites = len(np.unique(np.round(reading.place, 2) + 0.0, axis=0))
    return _SWEPT_KG_M2 * math.pi * radius_m**2 * (sites + _SECOND_ROTOR * (reading.motors - sites))


def _inertia(reading: Reading) -> tuple[float, float, float]:
    """Over mass and the square of the arm: masses at the motors, and a cylinder in the middle."""
    forward, right = (_AT_MOTORS * np.mean(reading.place**2, axis=0)).tolist()
    body = 1.0 - _AT_MOTORS
    tilt = body * (3.0 * _BODY_RADIUS**2 + _BODY_HEIGHT**2) / 12.0
    return right + tilt, forward + tilt, forward + right + body * _BODY_RADIUS**2 / 2.0


def _motor(lines: _Lines, reading: Reading, size: Size, mass: Known, radius_m: float) -> None:
    hover = reading.hover or Known(_HOVER, GUESSED)
    weight = f"of {mass.value:.4g} kg over {reading.motors} motors"
    origin = f"hovers at {hover.value:.3g} of it: {hover.origin}, {weight}"
    lag = Known(_LAG_S * math.sqrt(radius_m / _RADIUS_M), GUESSED)
    drag = reading.drag_per_arm
    lines.table("motor", "the same for all")
    thrust = mass.value * GRAVITY_M_S2 / (reading.motors * hover.value)
    lines.put("max_thrust_n", Known(thrust, f"{GUESSED}: {origin}" if hover.guessed or mass.guessed else origin))
    lines.put("time_constant_up_s", lag)
    lines.put("time_constant_down_s", lag)
    lines.put(
        "torque_per_thrust_m",
        Known(_DRAG_PER_RADIUS * radius_m, f"{GUESSED}: drag torque over thrust")
        if drag is None
        else Known(drag.value * size.arm_m, drag.origin),
    )
    lines.put(
        "rotor_inertia_kg_m2", Known(min(2e-5 * (radius_m / _RADIUS_M) ** 5, 10.0), f"{GUESSED}: the plant's own")
    )
    lines.put("max_speed_rad_s", Known(min(_TIP_M_S / radius_m, 9000.0), f"{GUESSED}: the plant's own"))


def _aerodynamics(lines: _Lines, arm_m: float, radius_m: float) -> None:
    lines.table("aerodynamics", "the plant's own, for simulated flights; the companion's model has none of it")
    arms, radii = arm_m / _ARM_M, radius_m / _RADIUS_M
    lines.put_list("drag_area_forward_m2", [area * arms**2 for area in (0.06, 0.065, 0.12)], GUESSED)
    lines.put_list("drag_area_backward_m2", [area * arms**2 for area in (0.07, 0.065, 0.15)], GUESSED)
    lines.put_list("pressure_centre_m", [0.0, 0.0, -0.04 * arm_m], GUESSED)
    for key, value in {
        "rotor_radius_m": radius_m,
        "rotor_drag_n_s_per_m": 0.3 * radii**2,
        "hub_height_m": 0.08 * arm_m,
        "hub_above_ground_m": 0.6 * arm_m,
        "translational_lift": 0.5,
        "wake_loss": 0.35,
        "flap_back_n_m_s_per_m": 0.01 * radii**2.5,
        "flap_side_n_m_s_per_m": 0.006 * radii**2.5,
    }.items():
        lines.put(key, Known(value, GUESSED))


def _rotors(lines: _Lines, reading: Reading, arm_m: float) -> None:
    ring = bool(np.allclose(np.hypot(*reading.place.T), 1.0, atol=1e-6))
    for (forward, right), spin in zip(reading.place.tolist(), reading.spin, strict=True):
        lines.lines += ["", "[[rotor]]"]
        if ring:
            angle = math.degrees(math.atan2(right, forward))
            lines.lines += [f"angle_deg = {round(angle, 3) + 0.0:g}", f"arm_m = {arm_m:.5g}"]
        else:
            lines.lines += [f"x_m = {arm_m * forward + 0.0:.5g}", f"y_m = {arm_m * right + 0.0:.5g}"]
        lines.lines.append(f'spin = "{SPIN_NAMES[int(spin)]}"')
