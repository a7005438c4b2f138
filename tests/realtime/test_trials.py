"""Surveys, the peer and the commands around them."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from nff_companion.cli.flight import parse_failures
from nff_companion.errors import ConfigError
from sitl.trials import survey
from sitl.trials.research.detectors import detector_of
from sitl.trials.survey import SurveyOptions, failure_sets, run, summary

NFF = [sys.executable, "-m", "nff_companion.cli.main"]


@pytest.mark.parametrize("detector", ["sparse", "imm", "rls", "current"])
def test_a_survey_flies_every_contender_on_the_same_seeds(detector: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(survey, "FLY_ON_S", 3.0)
    document = run(
        SurveyOptions(seeds=1, first_seed=2, detector=detector, rotor_speeds=detector == "current"), [(3,)], workers=1
    )
    (flight,) = document["flights"]
    assert flight["seed"] == 2
    assert flight["motors"] == [3]
    assert flight["named"] == [3]
    assert flight["survived"]
    assert 0.0 < flight["delay_s"] < 0.3
    assert document["summary"]["misnamed"] == document["summary"]["missed"] == 0


def test_failure_sets_are_all_singles_and_all_pairs() -> None:
    assert failure_sets(8, pairs=False) == [(m,) for m in range(1, 9)]
    assert len(failure_sets(8, pairs=True)) == 28


def test_summary_counts_what_went_wrong() -> None:
    flight = {"motors": [1], "seed": 1, "baseline_survived": True, "survived": False, "named": [2], "delay_s": None}
    flight |= {"max_tilt_deg": 90.0, "max_position_error_m": 10.0, "false_alarms": 1}
    totals = summary([flight])
    assert (totals["misnamed"], totals["missed"], totals["false_alarms"]) == (1, 1, 1)
    assert totals["lost_though_baseline_survived"] == 1
    assert totals["delay_median_s"] is None


def test_bad_options_are_one_line_and_exit_2() -> None:
    for arguments in (
        ["survey", "--mode", "fly"],
        ["survey", "--airframe", "brick"],
        ["demo", "--fail", "one@two"],
        ["compare", "--scenario", "moon"],
        ["compare", "--variant", "no-phi", "--network", "octo-x"],
        ["score", "--airframe", "octo-x"],
        ["score", "--airframe", "h250", "--simulate", "1"],
    ):
        result = subprocess.run([*NFF, *arguments], capture_output=True, text=True, check=False)
        assert result.returncode == 2
        assert result.stderr.startswith("nff:")
        assert "Traceback" not in result.stderr


def test_failures_are_read_as_motor_at_seconds() -> None:
    assert parse_failures(["1@5", "3@8.5"]) == [(1, 5.0), (3, 8.5)]
    with pytest.raises(ConfigError):
        parse_failures(["3"])


def test_an_unknown_detector_is_named_with_the_choices() -> None:
    with pytest.raises(ConfigError, match="rotor speeds"):
        detector_of("current")
    with pytest.raises(ConfigError, match="sparse, published, imm"):
        detector_of("oracle")


def test_bench_allocation_prints_one_document() -> None:
    result = subprocess.run([*NFF, "bench", "allocation", "--json"], capture_output=True, text=True, check=True)
    methods = json.loads(result.stdout)["methods"]
    assert set(methods) == {"pinv", "mca", "kim", "printed", "trim"}
    assert set(methods["trim"]["torque"]) >= {"healthy", "1", "8", "1+2", "7+8"}


@pytest.mark.realtime
def test_bench_loop_answers_every_sample_with_its_own_override() -> None:
    result = subprocess.run(
        [*NFF, "bench", "loop", "--rate", "200", "--seconds", "2", "--json"], capture_output=True, text=True, check=True
    )
    document = json.loads(result.stdout)
    assert document["samples"] > 0.9 * 400
    assert document["p50_us"] > 50.0, "no daemon answers before its step is done"
    assert document["rss_mb"] < 110.0
    assert {"p50_us", "p99_us", "p999_us", "echo_p50_us", "ratio_p50", "cpu_percent"} <= set(document)
