"""Arrows point one way: who may import whom."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PURE = ("core", "allocation", "control")
IMPURE = {
    "socket",
    "select",
    "time",
    "os",
    "asyncio",
    "threading",
    "subprocess",
    "multiprocessing",
    "pymavlink",
    "serial",
}
# What the emulated vehicle may take from the companion's package: the wire, and nothing that knows a vehicle.
SITL_MAY_IMPORT = ("nff_companion.mavlink", "nff_companion.errors")


def imports(path: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def files(folder: str) -> list[Path]:
    out = [p for p in sorted((ROOT / folder).rglob("*.py")) if p.name != "nff.py"]
    assert out
    return out


PLANT = [p for p in files("sitl") if "trials" not in p.parts]


@pytest.mark.parametrize("path", PLANT, ids=lambda p: str(p.relative_to(ROOT)))
def test_sitl_never_imports_the_companions_model(path: Path) -> None:
    taken = {name for name in imports(path) if name.startswith("nff_companion.")}
    assert {name for name in taken if not name.startswith(SITL_MAY_IMPORT)} == set()


@pytest.mark.parametrize(
    "path", [p for room in PURE for p in files(f"nff_companion/{room}")], ids=lambda p: str(p.relative_to(ROOT))
)
def test_pure_rooms_import_no_mavlink_socket_or_clock(path: Path) -> None:
    names = imports(path)
    assert {n for n in names if n.split(".")[0] in IMPURE} == set()
    rim = ("mavlink", "autopilots", "daemon", "cli", "replay", "session", "reporting", "training")
    assert {n for n in names if n.startswith(tuple(f"nff_companion.{r}" for r in rim)) or n.startswith("sitl")} == set()


@pytest.mark.parametrize("name", ["pipeline.py"])
def test_the_pipeline_knows_no_socket_and_no_clock(name: str) -> None:
    names = imports(ROOT / "nff_companion" / name)
    assert {n for n in names if n.split(".")[0] in IMPURE} == set()
    assert {n for n in names if n.startswith(("nff_companion.mavlink", "nff_companion.autopilots", "sitl"))} == set()


@pytest.mark.parametrize(
    "room", ["mavlink", "autopilots", "core", "allocation", "control", "training", "replay", "daemon"]
)
def test_only_trials_and_commands_know_the_emulated_vehicle(room: str) -> None:
    for path in files(f"nff_companion/{room}"):
        assert not {n for n in imports(path) if n.split(".")[0] == "sitl"}, path


def test_the_daemon_loads_neither_training_nor_plotting_nor_peers() -> None:
    import subprocess
    import sys

    code = (
        "import sys, nff_companion.cli.main, nff_companion.daemon.service; "
        "print([m for m in ('torch', 'filterpy', 'plotly', 'matplotlib', 'scipy', 'sitl') if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
