"""Arrows point one way: who may import whom, who runs the loop, who makes commands."""

from __future__ import annotations

import ast
import functools
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
GENERATED = "nff.py"
PURE = ("core", "allocation", "control")
PURE_FILES = ("admission.py", "companion.py", "companion_state.py", "condition.py", "outcome.py", "verdict.py")
IMPURE = {
    "asyncio",
    "multiprocessing",
    "os",
    "pymavlink",
    "select",
    "serial",
    "socket",
    "subprocess",
    "threading",
    "time",
}
# The rooms of the package from the ground up: each may use those before it.
FLOORS = (
    {"errors"},
    {"core", "mavlink", "state_file"},
    {"condition", "frames", "calibration"},
    {"allocation"},
    {"control"},
    {"admission", "companion_state"},
    {"outcome"},
    {"companion"},
    {"autopilots"},
    {"verdict", "announcer", "settings", "vehicle_link"},
    {"reporting"},
    {"voice"},
    {"session"},
    {"daemon", "replay", "training"},
    {"cli"},
)
# What the emulated vehicle may take from the companion's package: the wire, and nothing that knows a vehicle.
PLANT_MAY_IMPORT = ("nff_companion.mavlink", "nff_companion.errors")


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def files(folder: str) -> list[Path]:
    out = [p for p in sorted((ROOT / folder).rglob("*.py")) if p.name != GENERATED]
    assert out
    return out


MODULES = {module_of(path): path for folder in ("nff_companion", "sitl") for path in files(folder)}


@functools.cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@functools.cache
def imports(path: Path) -> set[str]:
    """Names of everything imported, modules and what is taken from them."""
    found: set[str] = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def needs(module: str) -> set[str]:
    """Modules of this project that ``module`` imports, anywhere in it; not the package where one of its modules is."""
    named = {name for name in imports(MODULES[module]) if name in MODULES and name != module}
    return {name for name in named if not any(other.startswith(f"{name}.") for other in named)}


def room(module: str) -> str:
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else ""


def test_no_module_comes_back_to_itself() -> None:
    order = list(TopologicalSorter({module: needs(module) for module in MODULES}).static_order())
    assert set(order) == set(MODULES)


def test_no_package_comes_back_to_itself() -> None:
    packages: dict[str, set[str]] = {}
    for module in MODULES:
        if not module.startswith("nff_companion."):
            continue
        mine = packages.setdefault(room(module), set())
        mine |= {room(other) for other in needs(module) if other.startswith("nff_companion.")}
        mine -= {room(module), ""}
    order = list(TopologicalSorter(packages).static_order())
    assert {"core", "session", "cli"} <= set(order)


def test_each_floor_stands_on_the_floors_below() -> None:
    level = {name: k for k, names in enumerate(FLOORS) for name in names}
    for module in MODULES:
        mine = room(module)
        if not module.startswith("nff_companion.") or not mine:
            continue
        assert mine in level, f"{module}: on which floor is it?"
        for other in needs(module):
            if other.startswith("nff_companion.") and room(other) not in (mine, ""):
                assert level[room(other)] < level[mine], f"{module} uses {other}"


@pytest.mark.parametrize(
    "path",
    [p for folder in PURE for p in files(f"nff_companion/{folder}")]
    + [ROOT / "nff_companion" / name for name in PURE_FILES],
    ids=lambda p: str(p.relative_to(ROOT)),
)
def test_pure_rooms_import_no_mavlink_socket_or_clock(path: Path) -> None:
    names = imports(path)
    assert {n for n in names if n.split(".")[0] in IMPURE} == set()
    assert {n for n in names if n.startswith(("nff_companion.mavlink", "sitl"))} == set()


@pytest.mark.parametrize("name", ["session.py", "reporting.py", "announcer.py", "settings.py"])
def test_the_session_knows_messages_but_no_socket_and_no_clock(name: str) -> None:
    assert {n for n in imports(ROOT / "nff_companion" / name) if n.split(".")[0] in IMPURE} == set()


@pytest.mark.parametrize(
    "path", [p for p in files("sitl") if "trials" not in p.parts], ids=lambda p: str(p.relative_to(ROOT))
)
def test_the_plant_never_imports_the_companions_model(path: Path) -> None:
    taken = {name for name in imports(path) if name.startswith("nff_companion.")}
    assert {name for name in taken if not name.startswith(PLANT_MAY_IMPORT)} == set()


def test_one_file_of_the_plant_knows_numba_and_the_companion_does_not() -> None:
    assert {m for m, p in MODULES.items() if "numba" in {n.split(".")[0] for n in imports(p)}} == {"sitl.compiled"}


def test_only_commands_know_the_emulated_vehicle() -> None:
    for module, path in MODULES.items():
        if module.startswith("nff_companion") and room(module) != "cli":
            assert not {n for n in imports(path) if n.split(".")[0] == "sitl"}, module


def bare_arrays(source: str) -> list[int]:
    """Lines where ``np.ndarray`` stands for a type without what it holds: anywhere but in isinstance."""
    tree, asked = ast.parse(source), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "isinstance":
            asked |= {id(part) for argument in node.args for part in ast.walk(argument)}
    found = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute) and node.attr == "ndarray"]
    return [node.lineno for node in found if id(node) not in asked]


@pytest.mark.parametrize("module", MODULES)
def test_every_annotation_says_what_an_array_holds(module: str) -> None:
    assert bare_arrays(MODULES[module].read_text(encoding="utf-8")) == []


def test_a_bare_array_is_found_in_an_annotation_and_in_an_alias_but_not_in_isinstance() -> None:
    source = "def f(x: np.ndarray) -> bool:\n    return isinstance(x, np.ndarray)\nRule = Callable[[int], np.ndarray]\n"
    assert sorted(bare_arrays(source)) == [1, 3]


# -- one loop, one schedule, one owner ----------------------------------------------------------------------------


def calls(path: Path, name: str) -> int:
    """How often something called ``name`` is called in a file, as a method or by its name."""
    count = 0
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Call):
            called = node.func
            count += isinstance(called, ast.Attribute) and called.attr == name
            count += isinstance(called, ast.Name) and called.id == name
    return count


def test_one_place_gives_messages_to_an_adapter_and_one_steps_the_companion_live() -> None:
    """Adoption gives the first heartbeat; logs are no live link."""
    observing = {m for m, p in MODULES.items() if "adapter.observe(" in p.read_text(encoding="utf-8")}
    assert observing == {"nff_companion.session", "nff_companion.autopilots.adoption", "sitl.trials.virtual"}
    responding = {m for m, p in MODULES.items() if calls(p, "respond")}
    assert responding == {"nff_companion.session"}


@pytest.mark.parametrize("command", ["Declare", "Load", "Release"])
def test_one_place_decides_what_is_told_and_when(command: str) -> None:
    assert {m for m, p in MODULES.items() if calls(p, command)} == {"nff_companion.autopilots.schedule"}


def test_outputs_are_driven_from_the_session_alone() -> None:
    assert {m for m, p in MODULES.items() if calls(p, "Drive")} == {"nff_companion.session"}


def test_commands_are_encoded_for_the_session_alone() -> None:
    encoding = {m for m, p in MODULES.items() if "adapter.encode(" in p.read_text(encoding="utf-8")}
    assert encoding == {"nff_companion.session"}


def test_an_adapter_has_at_most_nine_members() -> None:
    tree = parsed(ROOT / "nff_companion" / "autopilots" / "base.py")
    adapter = next(node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == "Adapter")
    members = [node for node in adapter.body if isinstance(node, ast.FunctionDef | ast.AnnAssign)]
    assert 5 <= len(members) <= 9


@pytest.mark.parametrize("module", [m for m in MODULES if room(m) in {r for floor in FLOORS[:11] for r in floor}])
def test_nothing_in_the_flying_code_compares_a_text_that_people_read(module: str) -> None:
    """A text with a space is for people; and nobody asks what ``text`` says."""
    for node in ast.walk(parsed(MODULES[module])):
        if not isinstance(node, ast.Compare):
            continue
        for part in (node.left, *node.comparators):
            spoken = isinstance(part, ast.Constant) and isinstance(part.value, str) and " " in part.value.strip()
            read = isinstance(part, ast.Attribute) and part.attr in ("text", "detail", "note")
            assert not (spoken or read), f"{module}:{node.lineno}"


def test_the_daemon_loads_neither_training_nor_plotting_nor_peers() -> None:
    code = (
        "import sys, nff_companion.cli.main, nff_companion.daemon.service; "
        "heavy = ('torch', 'filterpy', 'plotly', 'matplotlib', 'scipy', 'numba', 'sitl'); "
        "print([m for m in heavy if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
