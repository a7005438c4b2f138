"""Configuration of the daemon: one TOML file, validated and defaulted here."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from nff_companion.condition import Mode
from nff_companion.core.tuning import Tuning, check
from nff_companion.errors import ConfigError
from nff_companion.mavlink.endpoint import parse

ModeName = Literal["observe", "allocate", "override"]
MODES: dict[str, Mode] = {"observe": Mode.OBSERVE, "allocate": Mode.ALLOCATE, "override": Mode.OVERRIDE}


class LinkConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[link]``."""

    endpoint: str
    more_endpoints: list[str] = []
    autopilot: Literal["auto", "nff", "ardupilot", "px4"] = "auto"
    system: Annotated[int, msgspec.Meta(ge=0, le=255)] = 0  # of the autopilot; 0: the first one heard
    px4_method: Literal["scale", "inject"] = "scale"
    rate_hz: Annotated[float, msgspec.Meta(ge=25, le=1000)] = 200.0
    stream_timeout_s: Annotated[float, msgspec.Meta(gt=0, le=2)] = 0.25
    component: Annotated[int, msgspec.Meta(ge=191, le=194)] = 191


class VehicleConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[vehicle]``."""

    airframe: str
    thrust_to_weight: Annotated[float, msgspec.Meta(gt=1)] | None = None
    network: str = "airframe"  # basis: what the airframe file names; none; a shipped name or a path to an .npz file


class CompanionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[companion]``."""

    mode: ModeName = "allocate"
    allocation: str = "trim"
    status_socket: str = ""
    state_folder: str = ""


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
    """Read a configuration file. Raises ConfigError naming the key, its value and what is allowed."""
    try:
        config = msgspec.toml.decode(path.read_bytes(), type=Config)
    except OSError as error:
        raise ConfigError(f"configuration {path} cannot be read: {error.strerror}") from error
    except (msgspec.ValidationError, msgspec.DecodeError) as error:
        raise ConfigError(f"configuration {path}: {error}") from error
    for url in (config.link.endpoint, *config.link.more_endpoints):
        parse(url)
    check(config.tuning)
    return config
