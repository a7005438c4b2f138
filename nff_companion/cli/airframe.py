"""``nff airframe list``, ``show`` and ``new``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nff_companion.cli.output import console, print_json, say
from nff_companion.errors import ConfigError

if TYPE_CHECKING:
    from nff_companion.frames.catalogue import Frame
    from nff_companion.frames.parameter_file import Parameters
    from nff_companion.frames.reading import Reading

app = typer.Typer(no_args_is_help=True, help="Frames by name, and the airframe file of your vehicle.")
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on standard output.")]


def _document(frame: Frame, arm_m: float | None) -> dict[str, Any]:
    from nff_companion.frames.catalogue import SPIN_NAMES

    scale = 1.0 if arm_m is None else arm_m
    places, spins = (scale * frame.place).round(4).tolist(), frame.spin.tolist()
    motors = [
        {"motor": k, "forward": x + 0.0, "right": y + 0.0, "spin": None if spin == 0.0 else SPIN_NAMES[int(spin)]}
        for k, ((x, y), spin) in enumerate(zip(places, spins, strict=True), start=1)
    ]
    return {
        "name": frame.name,
        "ardupilot": [list(pair) for pair in frame.ardupilot],
        "px4": list(frame.px4),
        "without_model": frame.without or None,
        "arm_m": arm_m,
        "motors": motors,
    }


@app.command("list")
def list_command(json: Json = False) -> None:
    """Name every frame that ArduPilot and PX4 know, with the numbers that it has there."""
    from rich.table import Table
    from rich.text import Text

    from nff_companion.frames.catalogue import ANY_TYPE, frames

    if json:
        print_json({"frames": [_document(frame, None) for frame in frames().values()]})
        return
    table = Table(box=None)
    table.add_column("frame", no_wrap=True)
    for title in ("motors", "ArduPilot", "PX4"):
        table.add_column(title)
    for frame in frames().values():
        classes = ", ".join(f"{c} / {'others' if t == ANY_TYPE else t}" for c, t in frame.ardupilot)
        texts = (frame.name, str(frame.motors), classes, ", ".join(map(str, frame.px4)))
        table.add_row(*map(Text, texts))
    console.print(table)
    say("\nArduPilot: FRAME_CLASS / FRAME_TYPE. PX4: SYS_AUTOSTART.")
    for frame in frames().values():
        if frame.without:
            say(f"The companion has no model of {frame.name}: {frame.without}.")


@app.command()
def show(
    frame: Annotated[str, typer.Argument(help="Frame by name, or an airframe file (.toml).")],
    arm: Annotated[float | None, typer.Option(help="Of the farthest motor, in m; else places are in arms.")] = None,
    svg: Annotated[Path | None, typer.Option("--svg", help="Write the picture to this file.")] = None,
    json: Json = False,
) -> None:
    """Draw a frame as seen from above, nose up, with its motors' numbers and spins."""
    from rich.table import Table
    from rich.text import Text

    from nff_companion.frames import catalogue, drawing
    from nff_companion.frames.draft import Size

    if frame.endswith(".toml"):
        found, arm, same = _of_file(frame, arm)
    else:
        found, same = catalogue.by_name(frame), None
    if arm is not None:
        Size(arm).check()
    if svg is not None:
        _write(svg, drawing.svg(found, found.name))
    document = _document(found, arm)
    if frame.endswith(".toml"):
        document["frame"] = None if same is None else same.name
    if json:
        print_json(document)
        return
    say(drawing.characters(found) + "\n")
    unit = "arms" if arm is None else "m"
    table = Table("motor", f"x forward, {unit}", f"y right, {unit}", "spin", box=None)
    for motor in document["motors"]:
        texts = (str(motor["motor"]), f"{motor['forward']:.3f}", f"{motor['right']:.3f}", motor["spin"] or "-")
        table.add_row(*(Text(text, justify="right") for text in texts))
    console.print(table)
    if found.without:
        say(f"The companion has no model of it: {found.without}.")
    if frame.endswith(".toml"):
        say("It is no frame of the catalogue." if same is None else f"It is {same.name}, motor by motor.")
    if svg is not None:
        say(f"written: {svg}")


def _of_file(name: str, arm: float | None) -> tuple[Frame, float, Frame | None]:
    """Frame of an airframe file, its arm, and the frame of the catalogue that it does not contradict. Raises
    ConfigError."""
    import numpy as np

    from nff_companion.core import vehicle
    from nff_companion.frames import catalogue, comparison

    if arm is not None:
        raise ConfigError(f"--arm {arm}: the airframe file {name} has places in m; leave it out")
    loaded = vehicle.load(name)
    frame = catalogue.Frame(loaded.name, catalogue.scaled(loaded.hub_position_m), loaded.spin)
    return frame, float(np.hypot(*loaded.hub_position_m.T).max()), comparison.frame_of(loaded)


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be written: {getattr(error, 'strerror', None) or error}") from error


@app.command()
def new(
    out: Annotated[Path, typer.Option(help="The airframe file to make, .toml.")],
    arm: Annotated[float, typer.Option(help="From the centre to the farthest motor, in m.")],
    frame: Annotated[str, typer.Option(help="Frame by name, where the parameters do not say it.")] = "",
    mass: Annotated[float | None, typer.Option(help="Of the vehicle as it flies, in kg; else it is guessed.")] = None,
    parameters: Annotated[
        Path | None, typer.Option("--parameters", help="Parameter file of the autopilot: .param, .parm, .params.")
    ] = None,
    live: Annotated[str, typer.Option("--from", help="Ask a live autopilot: udpin:0.0.0.0:14550 and others.")] = "",
    timeout: Annotated[float, typer.Option(help="For --from, in s.", min=1.0)] = 60.0,
    autopilot: Annotated[str, typer.Option(help="Whose defaults, without parameters: ardupilot or px4.")] = "",
    json: Json = False,
) -> None:
    """Make an airframe file of a frame's name or the autopilot's parameters; what nobody said is marked as guessed."""
    from nff_companion.cli.parameters import given
    from nff_companion.frames import draft

    if out.suffix != ".toml":
        raise ConfigError(f"--out {out}: the suffix must be .toml")
    known = given(parameters, live, timeout)
    reading = _reading(frame, known, autopilot)
    source = (
        f"frame {frame}"
        if known is None
        else "a live autopilot"
        if live
        else f"parameter file {parameters.name if parameters else out.stem}"
    )
    made = draft.draft(reading, draft.Size(arm, mass), out.stem, source)
    draft.write(made.text, out)
    if json:
        named = None if reading.frame is None else reading.frame.name
        print_json({"file": str(out), "frame": named, "guessed": made.guessed, "notes": reading.notes})
        return
    say(f"{out}: {reading.title}, {reading.motors} motors")
    for note in reading.notes:
        say(note)
    say(f"guessed: {', '.join(made.guessed)}")
    say("Measure the mass, and compare motor order and spins with `nff airframe show` and the vehicle, propellers off.")


def _reading(name: str, parameters: Parameters | None, autopilot: str) -> Reading:
    """What is known, of a frame's name or parameters. Raises ConfigError."""
    from nff_companion.frames import ardupilot, catalogue, parameter_file, px4

    if autopilot not in ("", "ardupilot", "px4"):
        raise ConfigError(f"--autopilot {autopilot!r}: give ardupilot or px4")
    frame = catalogue.by_name(name) if name else None
    if parameters is None:
        if frame is None:
            raise ConfigError("give --frame NAME (`nff airframe list` names them), --parameters FILE or --from URL")
        return (px4 if autopilot == "px4" else ardupilot).defaults(frame)
    spoken = parameter_file.autopilot(parameters)
    if autopilot and autopilot != spoken:
        raise ConfigError(f"{parameters.origin} is of {spoken}, and --autopilot {autopilot} was given: leave it out")
    return (px4 if spoken == "px4" else ardupilot).read(parameters, frame)
