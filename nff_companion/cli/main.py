"""Entry point of ``nff``."""

from __future__ import annotations

import os
import sys

# One thread: the matrices are small, and idle BLAS threads would take memory and wake the cores in flight.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import typer

from nff_companion.cli import (
    airframe,
    bench,
    calibrate,
    campaign,
    compare,
    flight,
    fly,
    learn,
    operate,
    trials,
    why,
)
from nff_companion.cli.output import say_error
from nff_companion.errors import NffError

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Keeps a multirotor flying after motor failures.",
)
app.command("run")(operate.run)
app.command("status")(operate.status)
app.command("lift")(operate.lift)
app.command("mode")(operate.mode)
app.command("doctor")(operate.doctor)
app.command("check")(operate.check)
app.command("sitl")(flight.sitl)
app.command("demo")(flight.demo)
app.command("survey")(trials.survey)
app.command("campaign")(campaign.campaign)
app.command("replay")(trials.replay)
app.command("why")(why.why)
app.command("calibrate")(calibrate.calibrate)
app.command("compare")(compare.compare)
app.command("train")(learn.train)
app.command("score")(learn.score_command)
app.add_typer(airframe.app, name="airframe")
app.add_typer(bench.app, name="bench")
app.add_typer(fly.fly_app, name="fly")
app.add_typer(fly.ardupilot_app, name="ardupilot")


def main() -> None:
    """Run the command line; errors of ours are one line, not a trace."""
    try:
        app()
    except NffError as error:
        say_error(str(error))
        sys.exit(2)


if __name__ == "__main__":
    main()
