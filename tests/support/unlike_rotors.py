"""Airframe files of rotors of any kind."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nff_companion.core import vehicle
from nff_companion.core.vehicle import Vehicle

OCTO = vehicle.path_of("octo-x").read_text(encoding="utf-8")
TILT = 0.15


def having(lines: Sequence[str], *, head: Sequence[str] = (), delay: str = "", text: str = OCTO) -> str:
    """octo-x with a line added to each ``[[rotor]]``, to ``[airframe]`` and to ``[telemetry]``; empty: none."""
    first, *rotors = text.split("[[rotor]]\n")
    first = first.replace("[airframe]\n", "[airframe]\n" + "".join(f"{line}\n" for line in head))
    if delay:
        first = first.replace("[telemetry]\n", f"[telemetry]\noutput_delay_s = {delay}\n")
    assert len(rotors) == len(lines)
    return "[[rotor]]\n".join([first, *(f"{line}\n{rest}" for line, rest in zip(lines, rotors, strict=True))])


def every(line: str) -> list[str]:
    return [line] * 8


def first_alone(line: str) -> list[str]:
    return [line, *every("")[1:]]


def loaded(tmp_path: Path, text: str, **options: Any) -> Vehicle:
    return vehicle.load(str(written(tmp_path, text)), **options)


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "any.toml"
    path.write_text(text, encoding="utf-8")
    return path


def tilted_octo() -> str:
    """octo-x, each rotor tilted about its arm so that its push helps its drag in yaw; lower, unlike, off-centre."""
    octo, lines = vehicle.load("octo-x"), []
    for i in range(8):
        x, y = octo.position_m[i] / 0.5
        side = octo.spin[i] * TILT  # along (-y, x), which turns the vehicle about +z
        lines.append(
            f"z_m = {0.02 * i - 0.1:.3f}\naxis = [{-y * side:.6f}, {x * side:.6f}, -1.0]\n"
            f"thrust = {1.0 - 0.04 * (i % 3):.2f}\ntime_constant_down_s = {0.04 + 0.005 * i:.3f}"
        )
    return having(lines, head=["centre_of_mass_m = [0.02, -0.015, 0.03]"])


def measured_octo(yaw: NDArray[np.float64] | None = None) -> str:
    """octo-x by what each rotor was seen to do, some of it not as its place would have it; ``yaw`` (8,) rad/s^2."""
    octo = vehicle.load("octo-x")
    rows = (octo.acceleration_effectiveness * np.linspace(0.9, 1.1, 8)).T
    rows[:, 1:3] *= 1.05
    if yaw is not None:
        rows[:, 3] = yaw
    return having([f"acceleration = [{', '.join(f'{gain:.6f}' for gain in row)}]" for row in rows])
