"""``nff calibrate``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nff_companion.cli.output import console, print_json, say
from nff_companion.errors import ConfigError

if TYPE_CHECKING:
    from nff_companion.replay.calibrate import Calibration


def calibrate(
    logs: Annotated[list[Path], typer.Argument(help="Logs of healthy flight of one vehicle: .ulg, .bin, .tlog.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The airframe file to make, .toml.")],
    frame: Annotated[str, typer.Option(help="Frame by name, where the log does not say it: `nff airframe list`.")] = "",
    airframe: Annotated[str, typer.Option(help="Airframe file to begin with; its mass and arms are kept.")] = "",
    arm: Annotated[float, typer.Option(help="From the centre to the farthest motor, in m; 0: a typical one.")] = 0.0,
    mass: Annotated[float, typer.Option(help="Of the vehicle as it flies, in kg; 0: guessed by the arm.")] = 0.0,
    page: Annotated[Path | None, typer.Option(help="HTML page of what was measured against what is foretold.")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON document on standard output.")] = False,
) -> None:
    """Make an airframe file from ordinary healthy flight: accelerations alone count, so that arm and mass may be rough.

    Exit code 0: everything is known well enough, 1: the file is usable, and something is worth another flight, 2: no
    file was made.
    """
    from nff_companion.frames import draft
    from nff_companion.frames.draft import Size
    from nff_companion.replay import calibrate as calibration
    from nff_companion.replay.airframe_of_log import ARM_M
    from nff_companion.replay.page.calibration import page as page_of

    if out.suffix != ".toml":
        raise ConfigError(f"--out {out}: the suffix must be .toml")
    if out.exists():
        raise ConfigError(f"{out} exists already: give another name, or remove it")
    if airframe and (frame or arm or mass):
        raise ConfigError(f"--airframe {airframe}: the file says frame, arm and mass; leave those options out")
    size = Size(arm or ARM_M, mass or None) if arm or mass else None
    if size is not None:
        size.check()
    start = calibration.Start(airframe, frame, size)
    with console.status("fitting"):
        found = calibration.calibrate(logs, start, out.stem)
    draft.write(found.text, out)
    if page is not None:
        try:
            page.write_text(page_of(found, out.stem), encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"{page} cannot be written: {error.strerror}") from error
    if json:
        print_json(_document(found, out))
    else:
        _print(found, out)
    raise typer.Exit(int(not all(verdict.enough for verdict in found.verdicts)))


def _document(found: Calibration, out: Path) -> dict[str, Any]:
    return {
        "file": str(out),
        "flown_s": round(found.flown_s, 1),
        "numbers": [{"key": n.key, "value": n.value, "deviation": n.deviation, "unit": n.unit} for n in found.numbers],
        "verdicts": [
            {
                "name": v.name,
                "deviation": v.deviation,
                "most": v.most,
                "unit": v.unit,
                "enough": v.enough,
                "advice": "" if v.enough else v.advice,
            }
            for v in found.verdicts
        ],
        "explained": dict(zip(("thrust", "roll", "pitch", "yaw"), found.fit.explained.tolist(), strict=True)),
    }


def _print(found: Calibration, out: Path) -> None:
    from rich.table import Table

    table = Table("", "value", "+-", "", box=None)
    for n in found.numbers:
        value = ", ".join(f"{v:.3g}" for v in n.value) if isinstance(n.value, list) else f"{n.value:.4g}"
        table.add_row(n.key, value, f"{n.deviation:.2g}", n.unit)
    console.print(table)
    for verdict in found.verdicts:
        known = f"{verdict.name}: to {verdict.deviation:.2g} {verdict.unit}".rstrip()
        say(f"{known}, enough" if verdict.enough else f"{known}, wanted {verdict.most:g}: {verdict.advice}")
    say(f"{out}: from {found.flown_s:.0f} s of flight")
