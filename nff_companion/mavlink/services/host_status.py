"""ONBOARD_COMPUTER_STATUS: how the companion computer fares."""

from __future__ import annotations

import time

import psutil

from nff_companion.mavlink.codec import Message, dialect

_CORES = 8
_UNKNOWN = 255
_MEGABYTE = 2**20


def status_message() -> Message:
    """Load since the last call, memory, temperature and uptime of this computer."""
    cores = [min(round(share), 100) for share in psutil.cpu_percent(percpu=True)][:_CORES]
    memory = psutil.virtual_memory()
    celsius = [t.current for sensors in psutil.sensors_temperatures().values() for t in sensors]
    hottest = round(max(celsius)) if celsius else 127  # 127: not known
    return dialect.MAVLink_onboard_computer_status_message(
        time.time_ns() // 1000,
        round(1e3 * (time.time() - psutil.boot_time())) % 2**32,
        0,
        cores + [_UNKNOWN] * (_CORES - len(cores)),
        [_UNKNOWN] * 10,
        [_UNKNOWN] * 4,
        [_UNKNOWN] * 10,
        max(-128, min(hottest, 127)),
        [127] * 8,
        [32767] * 4,
        round((memory.total - memory.available) / _MEGABYTE),
        round(memory.total / _MEGABYTE),
        [2**32 - 1] * 4,
        [2**32 - 1] * 4,
        [2**32 - 1] * 4,
        [2**32 - 1] * 6,
        [2**32 - 1] * 6,
        [2**32 - 1] * 6,
        [2**32 - 1] * 6,
        [2**32 - 1] * 6,
    )
