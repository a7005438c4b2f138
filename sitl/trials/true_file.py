"""The airframe file that says of a plant what it is: for comparisons with what was measured or guessed of it."""

from __future__ import annotations

from pathlib import Path

import tomlkit

from sitl.airframe import PlantParameters


def text(nominal: Path, parameters: PlantParameters, vehicle: int) -> str:
    """The file ``nominal`` with the numbers of one plant."""
    document = tomlkit.parse(nominal.read_text(encoding="utf-8"))
    frame, motor, command = document["airframe"], document["motor"], document["command"]
    thrust_n = parameters.max_thrust_n[vehicle]
    frame["mass_kg"] = float(parameters.mass_kg[vehicle])
    frame["inertia_kg_m2"] = parameters.inertia_kg_m2[vehicle].tolist()
    motor["max_thrust_n"] = float(thrust_n.mean())
    motor["time_constant_up_s"] = float(parameters.time_constant_up_s[vehicle].mean())
    motor["time_constant_down_s"] = float(parameters.time_constant_down_s[vehicle].mean())
    motor["torque_per_thrust_m"] = float(parameters.torque_per_thrust_m[vehicle].mean())
    command["thrust_expo"] = float(parameters.thrust_expo[vehicle])
    command["spin_min"] = float(parameters.spin_min[vehicle])
    document["telemetry"]["output_delay_s"] = float(parameters.output_delay_s[vehicle])
    document["telemetry"]["gyro_filter_hz"] = float(parameters.gyro_filter_hz[vehicle])
    document["telemetry"]["accelerometer_filter_hz"] = float(parameters.accelerometer_filter_hz[vehicle])
    place = parameters.position_m if parameters.position_m.ndim == 2 else parameters.position_m[vehicle]
    for rotor, (x, y), n in zip(document["rotor"], place.tolist(), thrust_n.tolist(), strict=True):
        for key in ("angle_deg", "arm_m"):
            rotor.pop(key, None)
        rotor["x_m"], rotor["y_m"], rotor["thrust"] = x, y, n / float(thrust_n.mean())
    return tomlkit.dumps(document)
