"""Scripts in a real Lua 5.3, scheduled as the firmware does: each when it is due, removed when it fails."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from nff_companion.errors import MissingExtra

INSTRUCTION_LIMIT = 100_000  # SCR_VM_I_COUNT of our parameter files


class Firmware(Protocol):
    """What scripts can reach: an attribute for each of ``BINDINGS``, called by ``bindings.lua``."""

    def millis(self) -> int:
        """Milliseconds since boot."""


BINDINGS = (
    "millis",
    "micros",
    "parameter",
    "set_parameter",
    "add_table",
    "add_parameter",
    "armed",
    "interlock",
    "emergency_stop",
    "text",
    "channel_of",
    "override",
    "add_motor",
    "load_factors",
    "init_motors",
    "send",
)


@dataclass(slots=True)
class _Script:
    name: str
    function: Any
    next_ms: float


@dataclass(slots=True)
class LuaHost:
    """Runs the ``*.lua`` of a folder; ``modules/`` beside them are for ``require``. ``removed``: name to its error."""

    folder: Path
    firmware: Firmware
    instruction_limit: int = INSTRUCTION_LIMIT
    removed: dict[str, str] = field(default_factory=dict)
    _scripts: list[_Script] = field(default_factory=list)
    _runtime: Any = None
    _run: Callable[..., Any] | None = None
    _receive: Callable[..., Any] | None = None

    def __post_init__(self) -> None:
        try:
            from lupa.lua53 import LuaRuntime
        except ImportError as error:
            raise MissingExtra("the ArduPilot personality needs lupa: pip install 'nff-companion[sim]'") from error
        runtime = self._runtime = LuaRuntime(encoding=None, unpack_returned_tuples=True)
        prelude = (Path(__file__).parent / "bindings.lua").read_bytes()
        host = runtime.table()
        for name in BINDINGS:
            host[name.encode()] = getattr(self.firmware, name)
        host[b"module"] = self._module
        runtime.execute(b"host_prelude = ...", host)
        runtime.execute(b"local host = host_prelude\n" + prelude.replace(b"local host = ...", b"", 1))
        names = runtime.globals()
        self._run, self._receive = names[b"host_run"], names[b"host_receive"]
        for path in sorted(self.folder.glob("*.lua")):
            self.start(path)

    def _module(self, name: bytes) -> bytes | None:
        path = self.folder / "modules" / f"{name.decode()}.lua"
        return path.read_bytes() if path.is_file() else None

    def start(self, path: Path) -> None:
        """Load a script: it runs at the next step."""
        loaded = self._runtime.globals()[b"host_load"](path.read_bytes(), path.name.encode())
        if isinstance(loaded, tuple):
            self.removed[path.name] = loaded[1].decode(errors="replace")
            return
        self._scripts.append(_Script(path.name, loaded, -1.0))

    def stop(self, name: str) -> None:
        """Take a running script out, as the firmware does with one that fails."""
        self._scripts = [script for script in self._scripts if script.name != name]

    @property
    def running(self) -> list[str]:
        """Names of the scripts that run."""
        return [script.name for script in self._scripts]

    def step(self) -> None:
        """Run what is due now."""
        now = self.firmware.millis()
        for script in list(self._scripts):
            if now < script.next_ms:
                continue
            assert self._run is not None
            following, delay = self._run(script.function, self.instruction_limit)
            if following is None:
                self.stop(script.name)
                self.removed[script.name] = delay.decode(errors="replace")
                continue
            script.function, script.next_ms = following, now + delay

    def receive(self, message_id: int, message: bytes, channel: int) -> None:
        """Queue a ``mavlink_message_t``."""
        assert self._receive is not None
        self._receive(message_id, message, channel, self.firmware.millis())
