"""Flight logs: recorded telemetry of stock firmware, and real flights with a failed rotor."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import DATA

from nff_companion.companion import Companion
from nff_companion.condition import Condition, Mode
from nff_companion.core import vehicle
from nff_companion.core.decision import Event
from nff_companion.core.sample import Sample
from nff_companion.errors import LogError
from nff_companion.replay import tlog
from nff_companion.replay.run import rate_of, read, replay

EXCERPTS = json.loads((DATA / "truth.json").read_text(encoding="utf-8"))["logs"]
RECORDED = Path(os.environ["NFF_DATA"]) if os.environ.get("NFF_DATA") else None
needs_data = pytest.mark.skipif(RECORDED is None, reason="NFF_DATA is not set (README, section Data)")


@pytest.mark.parametrize("name", EXCERPTS)
def test_excerpts_of_stock_telemetry_name_the_failed_motors(name: str) -> None:
    truth = EXCERPTS[name]
    result = replay(DATA / name, vehicle.load("arducopter-octa-x"))
    assert sorted(f["motor"] for f in result["faults"]) == truth["motors"]
    for fault in result["faults"]:
        assert 0.0 < fault["time_s"] - truth["fault_s"] < 0.15
        assert fault["effectiveness"] < 0.1
        assert fault["confidence"] > 0.95


def test_replay_is_the_same_code_and_the_same_answer_every_time() -> None:
    model = vehicle.load("arducopter-octa-x")
    first, second = (replay(DATA / "ardupilot_motor7.tlog", model) for _ in range(2))
    assert first == second


def test_command_exits_1_with_faults_and_2_with_unreadable_logs(tmp_path: Path) -> None:
    def run(*paths: Path) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "nff_companion.cli.main", "replay", *map(str, paths)]
        return subprocess.run(
            [*command, "--airframe", "arducopter-octa-x", "--json"], capture_output=True, text=True, check=False
        )

    good = run(DATA / "ardupilot_motor7.tlog")
    assert good.returncode == 1
    assert [f["motor"] for f in json.loads(good.stdout)["flights"][0]["faults"]] == [7]
    (tmp_path / "bad.tlog").write_bytes(b"this is not a log" * 100)
    (tmp_path / "bad.ulg").write_bytes(b"nor is this" * 100)
    bad = run(tmp_path / "bad.tlog", tmp_path / "bad.ulg", tmp_path / "none.tlog")
    assert bad.returncode == 2
    assert json.loads(bad.stdout) == {"flights": []}
    assert bad.stderr.count("nff:") == 3


def test_unreadable_logs_are_errors_of_ours(tmp_path: Path) -> None:
    model = vehicle.load("octo-x")
    for name, data in (("a.tlog", b""), ("b.tlog", b"\0" * 400), ("c.txt", b"x"), ("d.ulg", b"ULog")):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(LogError):
            read(tmp_path / name, model)


@needs_data
class TestStockArduCopter:
    """Eleven recordings of stock ArduCopter."""

    @staticmethod
    def faults(name: str) -> list[tuple[int, float, float]]:
        assert RECORDED is not None
        path = RECORDED / "arducopter" / name
        truth = json.loads((RECORDED / "arducopter" / "truth.json").read_text(encoding="utf-8"))[name]
        result = replay(path, vehicle.load("arducopter-octa-x"))
        offset = tlog.first_stamp(path) - (truth["fault_unix_s"] or 0.0)
        return [(f["motor"], f["time_s"] + offset, f["effectiveness"]) for f in result["faults"]]

    def test_single_failures(self) -> None:
        """Of three motors; all eight, without an airframe file: test_why.py."""
        delays = []
        for motor in (2, 5, 8):
            found = self.faults(f"motor{motor}.tlog")
            assert [f[0] for f in found] == [motor]
            delays.append(found[0][1])
        print("delays", delays)
        assert min(delays) > 0.0
        assert np.median(delays) <= 0.060
        assert max(delays) <= 0.150

    def test_both_motors_of_the_pair_and_no_other(self) -> None:
        assert sorted(f[0] for f in self.faults("motors1+3.tlog")) == [1, 3]

    def test_partial_loss(self) -> None:
        ((motor, _, effectiveness),) = self.faults("motor4_half_pwm.tlog")
        assert motor == 4
        assert effectiveness == pytest.approx(0.22, abs=0.1)

    def test_nothing_from_boot_to_hover(self) -> None:
        assert self.faults("healthy.tlog") == []


def turned(
    vehicle_model: vehicle.Vehicle, rows: list[tuple[float, Sample]], quarters: int
) -> list[tuple[float, Sample]]:
    """The same flight seen in a body frame turned by quarter turns, rotors renumbered by as many places."""
    c, s = round(np.cos(quarters * np.pi / 2)), round(np.sin(quarters * np.pi / 2))
    spin = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], float)
    out = []
    for stamp, sample in rows:
        assert sample.thrust is not None
        out.append(
            (
                stamp,
                Sample(
                    time_s=sample.time_s,
                    gyro_rad_s=sample.gyro_rad_s @ spin,
                    specific_force_m_s2=sample.specific_force_m_s2 @ spin,
                    output=np.roll(sample.output, quarters),
                    armed=sample.armed,
                    position_m=sample.position_m,
                    thrust=np.roll(sample.thrust, quarters),
                ),
            )
        )
    return out


@needs_data
class TestRealFlights:
    """Twelve flights of a real quadrotor; rotor 1 stopped by a switch that is logged at 2 Hz."""

    @staticmethod
    def logs() -> list[Path]:
        assert RECORDED is not None
        found = sorted((RECORDED / "flights").glob("*.ulg"))
        assert len(found) == 12
        return found

    @staticmethod
    def switch_s(path: Path) -> tuple[float, float]:
        """Last record before the switch moved, and the first after."""
        from pyulog import ULog

        table = ULog(str(path), ["input_rc"]).data_list[0].data
        jump = int(np.flatnonzero(np.diff(table["values[5]"].astype(float)) > 100)[0])
        stamps = 1e-6 * table["timestamp"].astype(np.int64)
        return float(stamps[jump]), float(stamps[jump + 1])

    @pytest.mark.parametrize("quarters", [0, 1, 2, 3])
    def test_rotor_1_is_named_first_and_never_early_in_any_frame(self, quarters: int) -> None:
        model = vehicle.load("h250")
        seen = model.renumbered(quarters)
        # All flights as they are; each turn of the frame with one of them.
        for path in self.logs() if quarters == 0 else self.logs()[quarters - 1 : quarters]:
            before, _ = self.switch_s(path)
            _, rows = read(path, model)
            companion = Companion(seen, rate_of(s for _, s in rows))
            state = companion.start(Mode.OBSERVE)
            events: list[Event] = []
            for _, sample in turned(model, rows, quarters):
                state, output = companion.step(state, sample, Condition())
                events += output.events
                if events:
                    break
            assert events, path.name
            assert events[0].motor == 1 + quarters, path.name
            assert events[0].time_s > before, path.name
