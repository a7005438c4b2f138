"""ArduPilot's mixer as its source has it, line by line, and logs of vehicles that it flies (AP_MotorsMatrix.cpp,
AP_Motors_Thrust_Linearization.cpp, AC_AttitudeControl_Multi.cpp)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from conftest import DATA
from log_files import DataFlashFile
from numpy.typing import NDArray

from nff_companion.core.vehicle import Vehicle

Array = NDArray[np.float64]
LOOP_HZ, IMU_HZ, RCOU_HZ = 200, 50, 10
HOVER = 0.39


def factors(frame: str) -> Array:
    """(m, 3) of FRAME_CLASS and FRAME_TYPE, "3 1": normalise_rpy_factors of the firmware's own table."""
    lines = (DATA / "frames_ardupilot.txt").read_text(encoding="utf-8").splitlines()
    begin = lines.index(f"frame {frame}") + 1
    rows = []
    for line in lines[begin:]:
        if line.startswith("frame"):
            break
        rows.append([float(x) for x in line.split()[:3]])
    out = np.array(rows)
    for axis in range(3):
        out[:, axis] *= 0.5 / max(abs(out[:, axis]))
    return out


def stabilized(
    table: Array,
    roll: float,
    pitch: float,
    yaw: float,
    throttle: float,
    average_max: float,
    gain: float,
    headroom: float = 0.2,
) -> list[float]:
    """output_armed_stabilizing, without a lost motor."""
    roll, pitch, yaw, throttle, average_max = (gain * x for x in (roll, pitch, yaw, throttle, average_max))
    throttle_max = gain
    throttle = min(max(throttle, 0.0), throttle_max)
    average_max = min(max(average_max, throttle), throttle_max)
    best = min(0.5, average_max)
    yaw_allowed, out = 1.0, []
    for roll_factor, pitch_factor, yaw_factor in table:
        out.append(roll * roll_factor + pitch * pitch_factor)
        if yaw_factor != 0.0:
            at_best = best + out[-1]
            room = 1.0 - at_best if yaw * yaw_factor > 0.0 else at_best
            yaw_allowed = min(yaw_allowed, max(room, 0.0) / abs(yaw_factor))
    yaw_allowed = max(yaw_allowed, headroom)
    if abs(yaw) > yaw_allowed:
        yaw = min(max(yaw, -yaw_allowed), yaw_allowed)
    low, high = 1.0, -1.0
    for i, (_, _, yaw_factor) in enumerate(table):
        out[i] += yaw * yaw_factor
        low, high = min(low, out[i]), max(high, out[i])
    scale = 1.0
    if high - low > 1.0:
        scale = 1.0 / (high - low)
    if average_max + low < 0:
        scale = min(scale, -average_max / low)
    high *= scale
    low *= scale
    best = -low
    adjust = throttle - best
    if scale < 1.0 or adjust < 0.0:
        adjust = 0.0
    elif adjust > 1.0 - (best + high):
        adjust = 1.0 - (best + high)
    return [best + adjust + scale * x for x in out]


def actuator(vehicle: Vehicle, thrust: float, lift: float, voltage: float) -> float:
    """thrust_to_actuator."""
    c, e = vehicle.command, vehicle.command.thrust_expo
    thrust = min(max(thrust, 0.0), 1.0)
    ratio = lift * thrust
    if e != 0.0:
        ratio = ((e - 1.0) + math.sqrt((1.0 - e) * (1.0 - e) + 4.0 * e * lift * thrust)) / (2.0 * e)
    return c.spin_min + (c.spin_max - c.spin_min) * min(max(ratio / voltage, 0.0), 1.0)


@dataclass(kw_only=True)
class RateFlight:
    """A flight of ``vehicle`` whose motors ``table`` mixes. ``demand`` (time_s) -> roll, pitch, yaw, throttle."""

    vehicle: Vehicle
    table: Array
    demand: Callable[[float], Array]
    seconds: float = 12.0
    voltage: Callable[[float], float] = lambda time_s: 1.0
    thin_air: float = 1.0  # density of sea level over that here
    mix: float = 0.5  # ATC_THR_MIX_*
    idle_s: float = 0.0  # at the beginning it stands, its motors at MOT_SPIN_ARM
    parameters: dict[str, float] = field(default_factory=dict)
    leave_out: tuple[str, ...] = ()
    rate_every: int = 1  # loops
    rcou_hz: int = RCOU_HZ
    no_rate_s: tuple[float, float] = (0.0, 0.0)

    def output(self, time_s: float) -> list[float]:
        """Of each motor, 0..1."""
        if time_s < self.idle_s:
            return [0.1] * len(self.table)
        roll, pitch, yaw, throttle = self.demand(time_s).tolist()
        voltage = self.voltage(time_s)
        e = self.vehicle.command.thrust_expo
        lift = voltage * (1.0 - e) + e * voltage * voltage
        average_max = max(throttle, throttle * (1.0 - self.mix) + HOVER * self.mix)
        thrusts = stabilized(self.table, roll, pitch, yaw, throttle, average_max, self.thin_air / lift)
        return [actuator(self.vehicle, thrust, lift, voltage) for thrust in thrusts]

    def write(self, path: Path) -> Path:
        """The log."""
        c, log = self.vehicle.command, DataFlashFile()
        log.add("EV", 0, 10)
        motors = len(self.table)
        told = {"MOT_THST_EXPO": c.thrust_expo, "MOT_SPIN_MIN": c.spin_min, "MOT_SPIN_MAX": c.spin_max}
        told |= {"MOT_PWM_MIN": c.pwm_min, "MOT_PWM_MAX": c.pwm_max, "MOT_THST_HOVER": HOVER}
        told |= {f"SERVO{k}_FUNCTION": 32.0 + k for k in range(1, motors + 1)}
        for name, value in (told | self.parameters).items():
            log.add("PARM", 0, name.encode(), value)
        for loop in range(round(self.seconds * LOOP_HZ)):
            time_s = loop / LOOP_HZ
            usec = round(1e6 * time_s)
            demand = self.demand(time_s)
            if time_s < self.idle_s:
                demand[3] = 0.0
            if loop % self.rate_every == 0 and not self.no_rate_s[0] <= time_s < self.no_rate_s[1]:
                self._add(log, "RATE", usec, *demand)
            if loop % (LOOP_HZ // IMU_HZ) == 0:
                log.add("IMU", usec + 100, 0, 0.0, 0.0, 0.0, 0.0, 0.0, -9.81)
            if loop % (LOOP_HZ // self.rcou_hz) == 0:
                span = c.pwm_max - c.pwm_min
                pulses = [int(c.pwm_min + span * x) for x in self.output(time_s)]
                log.add("RCOU", usec + 700, *(pulses + [0] * 14)[:14])
                voltage = self.voltage(time_s)
                lift = voltage * (1.0 - c.thrust_expo) + c.thrust_expo * voltage * voltage
                self._add(log, "MOTB", usec + 600, lift, voltage)
        path.write_bytes(log.body)
        return path

    def _add(self, log: DataFlashFile, name: str, usec: int, *values: float) -> None:
        if name not in self.leave_out:
            log.add(name, usec, *values)


def lively(rng: np.random.Generator, size: float = 0.12, throttle: float = HOVER) -> Callable[[float], Array]:
    """Demands of a flight that turns up to 4 Hz about all axes, and climbs and descends."""
    frequency = rng.uniform(1.0, 4.0, (4, 3))
    phase = rng.uniform(0.0, 2.0 * np.pi, (4, 3))
    amplitude = np.array([size, size, 0.5 * size, 0.5 * size])

    def demand(time_s: float) -> Array:
        wave = np.sin(2.0 * np.pi * frequency * time_s + phase).mean(axis=1)
        return np.asarray(1.7 * amplitude * wave + np.array([0.01, -0.02, 0.01, throttle]))

    return demand
