"""README, Your airframe: from a log and a frame's name to a companion that observes, by the commands named there, and
to a flight that it protects."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flying import Flying, wait_for

from nff_companion.frames import catalogue
from nff_companion.frames.servo_functions import function_of
from sitl import airframe as plant_airframe
from sitl.faults import Fault
from sitl.fleet import Fleet, FleetOptions
from sitl.trials import flown_log
from sitl.trials.process import free_port
from sitl.trials.virtual import Px4Trial, TrialOptions, VirtualFlight
from sitl.uncertainty import Uncertainty

REFUSED = 2  # exit code
FLIGHT_S = 23.0  # little more than a calibration asks for


@dataclass(frozen=True, kw_only=True)
class Owned:
    """A vehicle that is not shipped."""

    frame: str
    arm_m: float
    mass_kg: float
    autopilot: str

    def __str__(self) -> str:
        return f"{self.frame} of {self.mass_kg:g} kg on {self.autopilot}"


OWNED = (
    Owned(frame="octo-plus", arm_m=0.75, mass_kg=12.0, autopilot="ardupilot"),
    Owned(frame="coax-x8", arm_m=0.3, mass_kg=5.0, autopilot="ardupilot"),
    Owned(frame="hexa-x", arm_m=0.35, mass_kg=3.8, autopilot="px4"),
)


class Owner:
    """Somebody at a shell, in a folder of his own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def nff(self, *arguments: str, codes: tuple[int, ...] = (0,)) -> Any:
        """The JSON document of a command that ends with one of ``codes``; None of one that was refused."""
        command = [sys.executable, "-m", "nff_companion.cli.main", *arguments, "--json"]
        done = subprocess.run(command, cwd=self.folder, capture_output=True, text=True, check=False)
        assert done.returncode in codes, done.stderr + done.stdout
        return None if done.returncode == REFUSED else json.loads(done.stdout)

    def runs(self, *arguments: str) -> subprocess.Popen[str]:
        """A command that goes on."""
        command = [sys.executable, "-m", "nff_companion.cli.main", *arguments]
        return subprocess.Popen(command, cwd=self.folder, stderr=subprocess.PIPE, text=True)


def saved_parameters(frame: str) -> str:
    """What a ground station saves of an ArduPilot that flies this frame."""
    known = catalogue.by_name(frame)
    frame_class, frame_type = known.ardupilot[0]
    values = {"FRAME_CLASS": frame_class, "FRAME_TYPE": frame_type}
    values |= {f"SERVO{motor}_FUNCTION": function_of(motor) for motor in range(1, known.motors + 1)}
    return "".join(f"{name},{value}\n" for name, value in values.items())


def protected(folder: Path, options: FleetOptions) -> None:
    """Motor 1 of the vehicle stops in hover, in virtual time: with the owner's file the emulated PX4 flies on."""
    plant = plant_airframe.load(folder / "plant.toml")
    fleet = Fleet(plant, options, [Fault(vehicle=0, motor=1, start_s=0.8)])
    trial = Px4Trial(state=folder / "journals")
    trial.state.mkdir()
    flown = VirtualFlight(fleet, {0: TrialOptions()}, airframe=str(folder / "mine.toml"), px4=trial)
    while fleet.time_s < 2.3:
        flown.step()
    (companion,) = flown.companions
    height, tilt = -float(fleet.state.position_m[0, 2]), float(np.degrees(fleet.max_tilt_rad[0]))
    print(height, tilt, companion.events)
    assert [event.motor for _, event in companion.events] == [1]
    assert companion.output.obstacle is None
    assert options.height_m - height < 0.5
    assert tilt < 25.0


@pytest.mark.parametrize("owned", OWNED, ids=str)
def test_a_vehicle_that_is_not_shipped_goes_from_its_log_to_being_observed(
    owned: Owned, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    owner = Owner(tmp_path)
    # The vehicle, off from what anybody would guess of it.
    size = ["--arm", f"{owned.arm_m}", "--mass", f"{owned.mass_kg}"]
    owner.nff("airframe", "new", "--frame", owned.frame, *size, "--autopilot", owned.autopilot, "--out", "plant.toml")
    options = FleetOptions(
        seeds=[7], height_m=20.0, wind_m_s=3.0, turbulence_m_s=0.7, model_error=0.1, uncertainty=Uncertainty.estimated()
    )
    plant = plant_airframe.load(tmp_path / "plant.toml")
    px4: dict[str, float] | None = {} if owned.autopilot == "px4" else None
    flown_log.write(Fleet(plant, options), [tmp_path / "flight.tlog"], FLIGHT_S, parameters=True, px4=px4)

    # Exit code 1: of so short a flight something may not be known well.
    made = owner.nff("calibrate", "flight.tlog", "--frame", owned.frame, "--out", "mine.toml", codes=(0, 1))
    print([verdict["name"] for verdict in made["verdicts"] if not verdict["enough"]])

    if px4 is not None:
        protected(tmp_path, options)

    card = None if owned.autopilot == "px4" else tmp_path / "card"
    if card is not None:
        (tmp_path / "now.param").write_text(saved_parameters(owned.frame), encoding="utf-8")
        owner.nff("ardupilot", "install", "--to", "card", "--airframe", "mine.toml", "--parameters", "now.param")
    port = free_port()
    fleet = Fleet(plant, options)
    fleet.autopilot.disarm(0)
    link = ["--airframe", "mine.toml", "--endpoint", f"udpin:127.0.0.1:{port}"]
    with Flying(fleet, [f"udpout:127.0.0.1:{port}"], card=card, px4=px4):
        found = {f["name"]: f for f in owner.nff("doctor", *link, "--timeout", "15", codes=(0, 1))["findings"]}
        not_ready = {name: f["detail"] for name, f in found.items() if f["ok"] is False}
        print(not_ready)
        assert f"adapter {owned.autopilot}" in found["link"]["detail"]
        assert set(not_ready) <= {"rates"}  # a busy machine
        daemon = owner.runs("run", *link)
        try:
            wait_for((tmp_path / "nff-companion.sock").exists, "the daemon's socket")
            seen = []

            def observed() -> bool:
                seen.append(owner.nff("status", codes=(0, REFUSED)))  # on a busy machine it answers late
                if seen[-1] is None:
                    return False
                return seen[-1]["autopilot"] is not None and seen[-1]["sample_age_s"] is not None

            wait_for(observed, "samples of the vehicle")
            assert (seen[-1]["airframe"], seen[-1]["mode"]) == ("mine", "observe")
        finally:
            daemon.terminate()
            daemon.communicate(timeout=20.0)
