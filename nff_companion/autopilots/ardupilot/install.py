"""``nff ardupilot install``: scripts, the airframe's tables and a parameter file onto the autopilot's card."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nff_companion.allocation import allocator, tables
from nff_companion.autopilots import times
from nff_companion.autopilots.ardupilot import factors
from nff_companion.autopilots.ardupilot.before import KEPT, Before
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import ConfigError
from nff_companion.frames.servo_functions import function_of

SCRIPTS = ("nff_companion.lua", "nff_watchdog.lua")
MODULES = ("nff_protocol.lua", "nff_mixer.lua", "nff_commands.lua")
AIRFRAME = "nff_airframe.lua"
TIMES = "nff_times.lua"
PARAMETERS = "nff_companion.parm"
# Of times.py, in whole milliseconds: what the applet and its watchdog go by.
APPLET_TIMES = {
    "MATRIX_TIMEOUT_MAX": times.MATRIX_TIMEOUT_MAX_S,
    "OVERRIDE_TIMEOUT": times.OVERRIDE_TIMEOUT_S,
    "STALE": times.STALE_S,
    "EARLY": times.EARLY_S,
    "LINK_LOST": times.LINK_LOST_S,
    "OWNER_LOST": times.OWNER_LOST_S,
    "STOP": times.STOP_S,
    "APPLIED_INTERVAL": times.APPLIED_INTERVAL_S,
    "APPLET_LATE": times.APPLET_LATE_S,
    "APPLET_DEAD": times.APPLET_DEAD_S,
    "WATCHDOG_SILENT": times.WATCHDOG_SILENT_S,
    "WATCHDOG_CALM": times.WATCHDOG_CALM_S,
    "WATCHDOG_ACTIVE": times.WATCHDOG_ACTIVE_S,
    "WATCHDOG_STOP": times.WATCHDOG_STOP_S,
}


def _source(*parts: str) -> bytes:
    folder = resources.files("nff_companion") / "autopilots" / "ardupilot" / "lua"
    for part in parts:
        folder = folder / part
    return folder.read_bytes()


def airframe_module(vehicle: Vehicle, rows: dict[int, NDArray[np.int16]], frame: int) -> str:
    """Lua module with what the scripts must know of the airframe; ``rows`` (m, 4) int16 by failed mask; ``frame``: the
    number of the one that was flown before, checks.FRAME_BEFORE."""
    command = vehicle.command
    lines = [
        f"-- {vehicle.name}: written by `nff ardupilot install`; factors as in nff_protocol.lua, by failed mask",
        "return {",
        f'  name = "{vehicle.name}",',
        f"  motors = {vehicle.motors},",
        f"  frame = {frame},",
        f"  pwm_min = {command.pwm_min:.0f},",
        f"  pwm_max = {command.pwm_max:.0f},",
        "  tables = {",
    ]
    for mask, table in sorted(rows.items()):
        text = "".join(f"\\x{byte:02x}" for byte in np.ascontiguousarray(table, "<i2").tobytes())
        lines.append(f'    [{mask}] = "{text}",')
    return "\n".join([*lines, "  },", "}", ""])


def times_module() -> str:
    """Lua module with the times of the protocol, in ms."""
    lines = ["-- Times of the protocol: written by `nff ardupilot install` from times.py", "return {"]
    lines += [f"  {name}_MS = {round(1e3 * seconds)}," for name, seconds in APPLET_TIMES.items()]
    return "\n".join([*lines, "}", ""])


def parameter_file(vehicle: Vehicle, *, scripted: bool) -> str:
    """Parameters to load with a ground station; without ``scripted`` the frame stays and only outputs can be sent."""
    lines = [
        f"# nff-companion on {vehicle.name}: load, then reboot the autopilot",
        "SCR_ENABLE 1",
        "SCR_HEAP_SIZE 200000",
        "SCR_VM_I_COUNT 100000",
    ]
    if scripted:
        lines += [
            "# the mixer's factors come from the applet; without it the vehicle does not arm",
            "FRAME_CLASS 17",
            "# bit 0: a reallocated vehicle must not trip the thrust-loss check",
            "FLIGHT_OPTIONS 1",
        ]
        lines += [f"SERVO{m}_FUNCTION {function_of(m)}" for m in range(1, vehicle.motors + 1)]
    return "\n".join([*lines, ""])


def install(
    vehicle: Vehicle, folder: Path, before: Before, *, scripted: bool = True, method: str = "trim"
) -> list[Path]:
    """Write everything into ``folder`` (the card's scripts directory); the files written. Raises ConfigError, and
    nothing is written, where the airframe is not what flew ``before``."""
    wrong = before.contradictions(vehicle)
    if wrong:
        raise ConfigError(
            f"airframe {vehicle.name} is not what this autopilot flies, nothing is installed: {'; '.join(wrong)}"
        )
    plans = tables.compute(vehicle, allocator(method))
    files = {folder / KEPT: before.kept.encode()}
    files |= {folder / name: _source(name) for name in SCRIPTS}
    files.update({folder / "modules" / name: _source("modules", name) for name in MODULES})
    module = airframe_module(vehicle, factors.of_plans(vehicle, plans), before.number)
    files[folder / "modules" / AIRFRAME] = module.encode()
    files[folder / "modules" / TIMES] = times_module().encode()
    files[folder / PARAMETERS] = parameter_file(vehicle, scripted=scripted).encode()
    try:
        (folder / "modules").mkdir(parents=True, exist_ok=True)
        for path, data in files.items():
            path.write_bytes(data)
    except OSError as error:
        raise ConfigError(f"{folder} cannot be written: {error.strerror}; give the card's scripts directory") from error
    return list(files)
