"""The six laws of the comparison, by name, in the pipeline and in the published scenario."""

from __future__ import annotations

import numpy as np
import pytest

from nff_companion import vehicle
from nff_companion.errors import NetworkError
from nff_companion.estimation.estimator import EstimatorOptions
from nff_companion.laws import LAWS
from nff_companion.pipeline import Mode, Pipeline, PipelineOptions
from nff_companion.trials.demo import DemoOptions, make_fleet
from nff_companion.trials.paper.figures import AXES, document
from nff_companion.trials.paper.scenario import GROUPS, Case, PaperOptions, fly, variants
from nff_companion.trials.virtual import VirtualFlight
from sitl.faults import Fault


@pytest.mark.parametrize("law", LAWS)
def test_each_law_flies_a_lost_motor_in_hover(law: str) -> None:
    fleet = make_fleet(DemoOptions(failures=[], wind_m_s=2.0))
    fleet.faults.add(Fault(vehicle=0, motor=3, start_s=3.0))
    flight = VirtualFlight(
        fleet,
        {0: PipelineOptions(mode=Mode.OVERRIDE, law=law)},
        airframe="octo-x",
        thrust_to_weight=None,
        rate_hz=200.0,
        link_delay_s=0.01,
    )
    pipeline = flight.companions[0].pipeline
    while fleet.time_s < 7.0:
        flight.step()
        if law == "omniscient" and fleet.time_s == 3.0:
            pipeline.adopt(np.eye(8, dtype=bool)[2])
    assert not fleet.state.crashed[0]
    output = pipeline.last
    assert output is not None
    assert output.mode == Mode.OVERRIDE
    knows = law in ("eff", "nff", "omniscient")
    assert bool(output.failed[2]) == knows
    assert (output.plan is not None) == knows
    assert [e.motor for _, e in flight.companions[0].events] == ([3] if LAWS[law].identify else [])
    learns = LAWS[law].learn
    assert (pipeline.network is not None) == learns
    assert pipeline._knowledge.residual.any() == learns


def test_an_unknown_network_is_refused_at_start() -> None:
    with pytest.raises(NetworkError, match="one of"):
        Pipeline(vehicle.load("octo-x"), 200.0, PipelineOptions(estimator=EstimatorOptions(network="somebody-elses")))


def test_the_published_scenario_gives_its_document() -> None:
    controllers = ("baseline", "nff", "omniscient")
    traces = fly(PaperOptions(controllers=controllers), [Case(c, g, 2) for c in controllers for g in GROUPS])
    result = document(traces)
    assert list(result["controllers"]) == list(controllers)
    for row in result["controllers"].values():
        assert set(row) == {"mean_position_error_m", "peak_attitude_error_deg", "crashes"}
        assert row["crashes"] == 0
        assert set(row["peak_attitude_error_deg"]["inner"]) == set(AXES)
    for group in GROUPS:
        assert set(result["gap_closed"][group]) == set(AXES)
    nff, baseline = result["controllers"]["nff"], result["controllers"]["baseline"]
    assert nff["mean_position_error_m"] < 0.6 * baseline["mean_position_error_m"]
    assert nff["peak_attitude_error_deg"]["outer"]["roll"] < 0.6 * baseline["peak_attitude_error_deg"]["outer"]["roll"]
    assert result["intervals"]["nff"]["named_right"] == 2


def test_every_variant_is_a_pipeline_of_the_same_law() -> None:
    assert "full" in variants()
    for name, options in variants().items():
        pipeline = Pipeline(vehicle.load("paper-octo"), 200.0, options)
        assert (pipeline.network is None) == (name == "no-phi")
