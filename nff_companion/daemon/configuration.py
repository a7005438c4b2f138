"""Configuration of the daemon: one TOML file, validated and defaulted here."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec

from nff_companion.condition import Mode
from nff_companion.core import toml_file
from nff_companion.core.toml_file import Name, Text
from nff_companion.core.tuning import Tuning, check
from nff_companion.core.tuning.span import about, shown, span
from nff_companion.core.vehicle import THRUST_TO_WEIGHT
from nff_companion.errors import ConfigError
from nff_companion.mavlink.urls import parse

ModeName = Literal["observe", "allocate", "override"]
MODES: dict[str, Mode] = {"observe": Mode.OBSERVE, "allocate": Mode.ALLOCATE, "override": Mode.OVERRIDE}
_SOCKET_PATH_MAX = 100  # bytes; the kernel takes 107
_WHAT = "configuration"
T = TypeVar("T", bound=msgspec.Struct)

# Where the options of the table [estimator], as it once was, have gone to.
_MOVED = {
    "network": "vehicle",
    "forgetting_per_s": "tuning.sparse",
    "gamma": "tuning.sparse",
    "solve_interval_s": "tuning.sparse",
    "gamma_onset": "tuning.onset",
}


class LinkConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[link]``."""

    endpoint: Annotated[
        Name, about("", "udpin:host:port, udpout:host:port, tcp:host:port, tcpin:host:port or /dev/tty:baud[,baud]")
    ]
    more_endpoints: Annotated[list[Name], about("", "others that are served, a ground station's for instance")] = []
    autopilot: Annotated[
        Literal["auto", "nff", "ardupilot", "px4"],
        about("", "nff is this project's own dialect; auto: as it says itself"),
    ] = "auto"
    system: Annotated[int, span(0, 255, "", "system id of the autopilot; 0: the one heard, several are refused")] = 0
    px4_method: Annotated[Literal["scale", "inject"], about("", "how PX4 is told of a matrix: docs/px4.md")] = "scale"
    rate_hz: Annotated[
        float, span(25, 1000, "Hz", "telemetry that is asked for, and that the estimator is built for")
    ] = 200.0
    stream_timeout_s: Annotated[float, span(0.02, 2.0, "s", "without samples for so long: observe")] = 0.25
    component: Annotated[int, span(191, 194, "", "MAVLink component id")] = 191


class VehicleConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[vehicle]``."""

    airframe: Annotated[Name, about("", "a shipped name, or a path to a .toml file")]
    network: Annotated[
        Name,
        about("", "basis of Neural-Fly: airframe, what the airframe file names; drag; none; a shipped name, or a file"),
    ] = "airframe"
    thrust_to_weight: (
        Annotated[float, span(*THRUST_TO_WEIGHT, "", "replaces the maximum thrust of the airframe file")] | None
    ) = None


class CompanionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[companion]``."""

    mode: Annotated[
        ModeName, about("", "first flights observe; declarations and matrices, or motor outputs, are asked for by name")
    ] = "observe"
    confirmed: Annotated[
        bool,
        about("", "the airframe file is this vehicle's: act at once; else when it says so, or a flight shows it"),
    ] = False
    allocation: Annotated[
        Literal["pinv", "mca", "kim", "printed", "trim"], about("", "method of allocation; trim is the one that flies")
    ] = "trim"
    propose: Annotated[
        bool,
        about(
            "", "after a landing, calibrate from what was flown, and write a better airframe file beside: docs/fit.md"
        ),
    ] = True
    status_socket: Annotated[Text, about("", "where nff monitor asks; empty: in the runtime folder")] = ""
    state_folder: Annotated[
        Text, about("", "journal of changed PX4 parameters, proposed airframe files; empty: the service's own")
    ] = ""


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole file."""

    link: LinkConfig
    vehicle: VehicleConfig
    companion: CompanionConfig = CompanionConfig()
    tuning: Tuning = Tuning()


def default_status_socket() -> str:
    """Where a daemon and its monitor meet unless told otherwise."""
    folder = os.environ.get("RUNTIME_DIRECTORY") or os.environ.get("XDG_RUNTIME_DIR") or "/run/nff-companion"
    return str(Path(folder.split(":")[0]) / "nff-companion.sock")


def default_state_folder() -> str:
    """Where what must survive a crash is kept."""
    folder = os.environ.get("STATE_DIRECTORY") or os.environ.get("XDG_STATE_HOME") or "/var/lib/nff-companion"
    return folder.split(":")[0]


def load(path: Path) -> Config:
    """Read a configuration file. Raises ConfigError naming file, key, value and what is allowed."""
    raw = toml_file.parsed(path, _WHAT)
    moved = _moved(raw)
    if moved:
        raise ConfigError(f"{_WHAT} {path}: {moved}")
    return _checked(raw, path)


def given(path: Path | None, airframe: str, endpoint: str) -> Config:
    """The configuration file ``path``; or, without one, an airframe and an endpoint, and the defaults of all else: it
    observes. Raises ConfigError."""
    if path is not None:
        if airframe or endpoint:
            raise ConfigError(f"--config {path}: the file says airframe and endpoint; leave those options out")
        return load(path)
    if not (airframe and endpoint):
        raise ConfigError("give --config FILE, or --airframe FILE and --endpoint URL (udpin:0.0.0.0:14550 and others)")
    return _checked({"link": {"endpoint": endpoint}, "vehicle": {"airframe": airframe}}, Path("command line"))


def _checked(raw: dict[str, Any], path: Path) -> Config:
    """Raises ConfigError."""
    config = toml_file.converted(raw, Config, path, _WHAT)
    try:
        check(config.tuning)
        for number, url in enumerate((config.link.endpoint, *config.link.more_endpoints)):
            _check_endpoint(url, number)
        if len(config.companion.status_socket.encode()) > _SOCKET_PATH_MAX:
            raise ConfigError(
                f"companion.status_socket = {shown(config.companion.status_socket)}: at most"
                f" {_SOCKET_PATH_MAX} bytes are allowed"
            )
    except ConfigError as error:
        raise ConfigError(f"{_WHAT} {path}: {error}") from error
    return config


def _check_endpoint(url: str, number: int) -> None:
    try:
        parse(url)
    except ConfigError as error:
        raise ConfigError(f"link.{f'more_endpoints[{number}]' if number else 'endpoint'}: {error}") from error


def _moved(raw: dict[str, Any]) -> str | None:
    """Where to write what stands in the old table ``[estimator]``; None when there is none."""
    if "estimator" not in raw:
        return None
    table = raw["estimator"]
    for key, value in table.items() if isinstance(table, dict) else ():
        if key in ("decision", "adaptation"):
            inner = ", ".join(f"{key}.{name}" for name in value) if isinstance(value, dict) else key
            return f"[estimator.{key}] is now [tuning.{key}]: write tuning.{inner or key}"
        if key in _MOVED:
            return f"estimator.{key} is now {_MOVED[key]}.{key}: write [{_MOVED[key]}] {key}"
        return f"estimator.{shown(key)[1:-1]} is no option of a configuration, at most one of trials: remove it"
    return "[estimator] is no more: its network is now vehicle.network, its numbers are in [tuning.*]: docs/tuning.md"
