"""Time of one step of the companion on kept flights: median and 99th percentile, us, in allocate and override.

``python benchmarks/step.py`` replays samples of ``tests/golden``; with ``--against DIR`` another checkout replays the
same ones in turn, block by block, and the ratio of the medians (this one over that one) is printed. Each checkout runs
in a process of its own, so that only what it imports differs.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[1]
CASES = {
    "hover, allocate": ("hover", "allocate"),
    "hover, override": ("hover", "override"),
    "forward, allocate": ("forward", "allocate"),
    "forward, override": ("forward", "override"),
    "override": ("override", "override"),
    "single": ("single", "allocate"),
}
_WARM_UP = 200  # steps of each replay that do not count: the start of a flight, caches


def timed_replay(flights: Any, name: str, mode: str) -> list[int]:
    """Nanoseconds of each ``respond`` and ``step`` together, over one replay."""
    taken: list[int] = []
    kind = "Companion" if hasattr(flights, "Companion") else "Pipeline"  # what it was called before
    plain = getattr(flights, kind)

    class Timed(plain):  # type: ignore[misc,valid-type]
        responded_ns = 0

        def respond(self, *arguments: Any) -> Any:
            began = time.perf_counter_ns()
            answer = super().respond(*arguments)
            self.responded_ns = time.perf_counter_ns() - began
            return answer

        def step(self, *arguments: Any, **named: Any) -> Any:
            began = time.perf_counter_ns()
            output = super().step(*arguments, **named)
            taken.append(time.perf_counter_ns() - began + self.responded_ns)
            return output

    setattr(flights, kind, Timed)
    try:
        inputs, _, _ = flights.load(name)
        flights.replay(dataclasses.replace(flights.FLIGHTS[name], mode=mode), flights.unpack(inputs))
    finally:
        setattr(flights, kind, plain)
    return taken[_WARM_UP:]


def serve() -> None:
    """Replay what standard input names, one case a line, and answer with the times."""
    from golden import flights

    print(json.dumps(flights.__file__), flush=True)
    for line in sys.stdin:
        print(json.dumps(timed_replay(flights, *CASES[line.strip()])), flush=True)


class Checkout:
    """A process that replays flights with the sources of one folder."""

    def __init__(self, folder: Path) -> None:
        paths = os.pathsep.join([str(folder), str(folder / "tests")])
        self._process = subprocess.Popen(
            [sys.executable, str(Path(__file__).resolve()), "--serve"],
            env={**os.environ, "PYTHONPATH": paths, "OPENBLAS_NUM_THREADS": "1"},
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        loaded = Path(self._read())
        if not loaded.is_relative_to(folder):
            raise SystemExit(f"{folder}: flights were loaded from {loaded}")

    def _read(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit(f"a replay ended with code {self._process.wait()}")
        return json.loads(line)

    def times_ns(self, case: str) -> list[int]:
        assert self._process.stdin is not None
        self._process.stdin.write(case + "\n")
        self._process.stdin.flush()
        times: list[int] = self._read()
        return times

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def main() -> None:
    import numpy as np

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--against", type=Path, help="another checkout of this project")
    parser.add_argument("--blocks", type=int, default=3, help="replays of each case by each checkout")
    parser.add_argument("--case", action="append", choices=list(CASES), help="only this one; several")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve()
        return
    folders = [HERE] + ([options.against.resolve()] if options.against else [])
    checkouts = [Checkout(folder) for folder in folders]
    for case in options.case or CASES:
        times: list[list[int]] = [[] for _ in checkouts]
        for _ in range(options.blocks):
            for checkout, taken in zip(checkouts, times, strict=True):
                taken.extend(checkout.times_ns(case))
        found = [np.percentile(1e-3 * np.array(taken), [50.0, 99.0]) for taken in times]
        line = f"{case:18} median {found[0][0]:6.1f} us, p99 {found[0][1]:7.1f} us"
        if options.against:
            line += f"; other {found[1][0]:6.1f} and {found[1][1]:7.1f} us; ratio {found[0][0] / found[1][0]:.3f}"
        print(line, flush=True)
    for checkout in checkouts:
        checkout.close()


if __name__ == "__main__":
    main()
