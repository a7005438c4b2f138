"""In which words a calibrated airframe differs from the file that was flown; differences that are worth a word."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from nff_companion.calibration import model
from nff_companion.calibration.fit import Fit
from nff_companion.core.tuning import FitTuning
from nff_companion.core.vehicle import AXES, THRUST, Vehicle

_SURE = 2.0  # deviations
_CURVE, _DELAY_S, _CENTRE = 0.15, 0.005, 0.05  # of expo; of the outputs; of the arm


def differences(file: Vehicle, found: Vehicle, fit: Fit, tuning: FitTuning) -> Iterator[tuple[str, str]]:
    """(short for the pilot, sentence) of each number of ``found`` that is off the ``file``'s by more than ``tuning``
    says is worth saying, and by more than twice what it may be off itself."""
    d, layout = fit.deviation, fit.layout
    was, now = (0.5e3 * (v.motor.time_constant_up_s + v.motor.time_constant_down_s) for v in (file, found))
    if abs(now - was) > max(1e3 * tuning.said_lag_s, _SURE * now * float(d[model.LAG])):
        yield f"motors take {now:.0f} ms, file {was:.0f}", f"motors respond in {now:.0f} ms, the file says {was:.0f}"
    ratios = np.linalg.norm(found.acceleration_effectiveness, axis=1) / np.linalg.norm(
        file.acceleration_effectiveness, axis=1
    )
    for axis, ratio, gain in zip(AXES, ratios.tolist(), d[model.gains_of(layout)].tolist(), strict=True):
        least = tuning.said_thrust if axis == AXES[THRUST] else tuning.said_turn
        if abs(np.log(ratio)) > max(np.log(least), _SURE * gain):
            what = "full thrust over mass" if axis == AXES[THRUST] else f"{axis} per thrust"
            yield f"{what} x {ratio:.2f}", f"{what} is {ratio:.2f} times what the file says"
    was, now = file.command.thrust_expo, found.command.thrust_expo
    if d[model.EXPO] > 0.0 and abs(now - was) > max(_CURVE, _SURE * float(d[model.EXPO])):
        yield f"thrust curve {now:.2f}, file {was:.2f}", f"thrust_expo is {now:.2f}, the file says {was:.2f}"
    was, now = file.telemetry.output_delay_s, found.telemetry.output_delay_s
    if abs(now - was) > max(_DELAY_S, _SURE * float(d[model.DELAY])):
        said = f"outputs show {1e3 * now:.0f} ms late, the file says {1e3 * was:.0f}"
        yield f"outputs {1e3 * now:.0f} ms late, file {1e3 * was:.0f}", said
    arm_m = model.arm_m(file)
    moved_m = (file.position_m - found.position_m).mean(axis=0)
    if np.abs(moved_m).max() > arm_m * max(_CENTRE, _SURE * float(d[model.centre_of(layout)].max())):
        forward, right = (100.0 * moved_m).tolist()
        said = f"the centre of mass is {forward:+.0f} cm forward and {right:+.0f} cm to the right of the file's"
        yield f"centre of mass {forward:+.0f}, {right:+.0f} cm", said
