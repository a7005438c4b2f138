"""``nff check`` in flight: the real command against the emulated vehicle, with its file and with another one's."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from flying import Flying, wait_for

from nff_companion.core import vehicle
from sitl import airframe as plant_airframe
from sitl.fleet import Fleet, FleetOptions
from sitl.trials import wrong_file
from sitl.trials.first_seconds import TakeOff
from sitl.trials.process import config_text, free_port, start
from sitl.trials.wrong_file import Case

SECONDS = 10.0  # after the first thing was seen


class Check:
    """``nff check`` as a process that listens at a port of its own."""

    def __init__(self, folder: Path, airframe: str) -> None:
        folder.mkdir()
        self.port, self._said, self._answer = free_port(), folder / "said", folder / "answer"
        text = config_text(
            endpoint=f"udpin:127.0.0.1:{self.port}",
            airframe=airframe,
            mode="observe",
            rate_hz=200.0,
            socket=folder / "s",
        )
        (folder / "c.toml").write_text(text.replace("confirmed = true\n", ""), encoding="utf-8")
        command = [
            sys.executable,
            "-m",
            "nff_companion.cli.main",
            "check",
            "--config",
            str(folder / "c.toml"),
            "--json",
        ]
        with self._said.open("wb") as said, self._answer.open("wb") as answer:
            self.process: subprocess.Popen[bytes] = start(
                [*command, "--seconds", str(SECONDS)], stdout=answer, stderr=said
            )

    @property
    def said(self) -> str:
        return self._said.read_text(encoding="utf-8")

    @property
    def answer(self) -> dict[str, object]:
        document: dict[str, object] = json.loads(self._answer.read_text(encoding="utf-8"))
        return document


@pytest.mark.realtime
def test_a_check_in_flight_knows_the_vehicles_own_file_from_another_ones(tmp_path: Path) -> None:
    swapped = wrong_file.altered("octo-x", Case("swap", motors=(2, 4)), tmp_path / "swapped.toml")
    right, wrong = Check(tmp_path / "right", "octo-x"), Check(tmp_path / "wrong", swapped)
    fleet = Fleet(plant_airframe.load(vehicle.path_of("octo-x")), FleetOptions(seeds=[3], wind_m_s=1.0))
    pilot, began_s = TakeOff(fleet, turn=True), list[float]()

    def cycle(flown: Fleet) -> None:
        if began_s:
            pilot.step(flown.time_s - began_s[0])

    try:
        with Flying(fleet, [f"udpout:127.0.0.1:{each.port}" for each in (right, wrong)], on_cycle=cycle):
            wait_for(lambda: "not flying" in right.said and "not flying" in wrong.said, "samples on the ground")
            began_s.append(fleet.time_s)
            codes = [each.process.wait(180.0) for each in (right, wrong)]
            assert not fleet.state.crashed[0]
    finally:
        for each in (right, wrong):
            each.process.kill()
            print(each.said)
    assert codes == [0, 1]
    assert right.answer["verdict"] == "fits"
    assert wrong.answer["text"] == "motors 2, 4 swapped, as the motion shows"
