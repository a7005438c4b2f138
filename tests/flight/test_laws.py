"""The six laws of the comparison, by name, in a flight and in the published scenario."""

from __future__ import annotations

import dataclasses
import json
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import numpy as np
import pytest

from nff_companion.companion_state import Orders
from nff_companion.condition import Mode
from nff_companion.core import basis_network, vehicle
from nff_companion.core.estimate import Estimate
from nff_companion.core.tuning import AdaptationTuning
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import NetworkError
from sitl import airframe
from sitl.faults import Fault
from sitl.fleet import Fleet, FleetOptions
from sitl.trials.demo import DemoOptions, make_fleet
from sitl.trials.paper import figures
from sitl.trials.paper.figures import AXES, document
from sitl.trials.paper.scenario import AFTER_S, GROUPS, Case, PaperOptions, Trace, fly, trial_options, variants
from sitl.trials.research.adapted import AdaptedMatrix
from sitl.trials.research.laws import LAWS
from sitl.trials.virtual import TrialOptions, VirtualFlight


@pytest.fixture(scope="module")
def flown() -> VirtualFlight:
    """All laws, each with a vehicle of its own that flies as the others do; motor 3 is lost at 3 s."""
    nominal = airframe.load(vehicle.path_of("octo-x"))
    options = FleetOptions(seeds=[1] * len(LAWS), wind_m_s=2.0, turbulence_m_s=0.5, height_m=10.0)
    fleet = Fleet(nominal, options, [Fault(vehicle=k, motor=3, start_s=3.0) for k in range(len(LAWS))])
    trials = {k: TrialOptions(mode=Mode.OVERRIDE, parts=parts) for k, parts in enumerate(LAWS.values())}
    flight = VirtualFlight(fleet, trials, airframe="octo-x", thrust_to_weight=None, rate_hz=200.0, link_delay_s=0.01)
    while fleet.time_s < 7.0:
        flight.step()
        if fleet.time_s == 3.0:
            flight.companions[list(LAWS).index("omniscient")].order(Orders(adopt=(3,)))
    return flight


@pytest.mark.parametrize("law", LAWS)
def test_each_law_flies_a_lost_motor_in_hover(flown: VirtualFlight, law: str) -> None:
    index = list(LAWS).index(law)
    companion = flown.companions[index]
    assert not flown.fleet.state.crashed[index]
    output = companion.output
    assert output.mode == Mode.OVERRIDE
    knows = law in ("eff", "nff", "omniscient")
    assert bool(output.failed[2]) == knows
    assert (output.plan is not None) == knows
    assert [e.motor for _, e in companion.events] == ([3] if LAWS[law].identify else [])
    learns = LAWS[law].learn
    assert companion.session.state.knowledge.residual.any() == learns


def test_an_unknown_network_is_refused_at_start() -> None:
    with pytest.raises(NetworkError, match="one of"):
        basis_network.for_vehicle(vehicle.load("octo-x"), "somebody-elses")


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


def test_every_variant_is_of_the_same_law() -> None:
    assert "full" in variants()
    for name, variant in variants().items():
        assert (variant.network == "none") == (name == "no-phi")
        assert variant.parts(LAWS["nff"]).identify
        chosen = trial_options(PaperOptions(variant=name), "nff")
        assert (chosen.mode, chosen.parts.name) == (Mode.OVERRIDE, "nff")


def trace(error_deg: float, error_m: float, *, until_s: float = AFTER_S, seed: int = 1, law: str = "nff") -> Trace:
    """A flight with constant errors that ends at ``until_s``."""
    at = np.arange(-1.0, until_s, 0.005)
    rows = len(at)
    return Trace(
        case=Case(law, "outer", seed),
        time_s=at,
        attitude_error_deg=np.full((rows, 3), error_deg),
        position_error_m=np.full(rows, error_m),
        effectiveness=np.ones((rows, 8)),
        named=[],
        delay_s=None,
        crashed=until_s < AFTER_S,
    )


@pytest.mark.parametrize("until_s", [-2.0, -0.5, 0.6, 7.0])
def test_a_crash_is_never_a_gain(until_s: float) -> None:
    crashed = trace(2.0, 0.1, until_s=until_s)
    flown = trace(40.0, 5.0)
    assert np.array_equal(figures.peak_deg(crashed), np.full(3, 90.0))
    assert figures.mean_position_error_m(crashed) > figures.mean_position_error_m(flown) == pytest.approx(5.0)
    assert np.isfinite(figures.attitude_curve_deg(crashed)).all()
    assert np.isfinite(figures.position_error_before_m(crashed))


def test_moments_without_a_closed_loop_are_no_error_and_a_flight_of_them_a_crash() -> None:
    flight = trace(3.0, 0.1)
    flight.attitude_error_deg[250:260] = np.nan
    assert figures.peak_deg(flight).tolist() == [3.0] * 3
    flight.attitude_error_deg[:] = np.nan
    assert figures.peak_deg(flight).tolist() == [90.0] * 3


def test_intervals_hold_the_mean_of_all_seeds_and_shrink_with_the_spread(rng: np.random.Generator) -> None:
    bootstrap = figures.Bootstrap(20)
    values = 5.0 + rng.standard_normal(20)
    low, high = figures.interval(bootstrap.means(values))
    assert low < values.mean() < high
    expected = 1.96 * values.std() / np.sqrt(20)
    assert (high - low) / 2 == pytest.approx(expected, rel=0.1)
    curves = rng.standard_normal((20, 7, 3))
    assert bootstrap.means(curves).shape[1:] == (7, 3)
    np.testing.assert_allclose(bootstrap.means(curves).mean(axis=0), curves.mean(axis=0), atol=0.02)


def test_the_gap_closed_and_the_change_against_baseline_are_what_they_say() -> None:
    errors = {"baseline": (10.0, 2.0), "nff": (4.0, 0.5), "omniscient": (2.0, 0.4)}
    traces = [
        dataclasses.replace(trace(*error), case=Case(law, group, seed))
        for law, error in errors.items()
        for group in GROUPS
        for seed in (1, 2, 3)
    ]
    result = figures.document(traces)
    assert result["gap_closed"]["inner"]["yaw"] == pytest.approx(0.75)
    assert result["gap_closed_of_mean_curve"]["outer"]["share"]["roll"] == pytest.approx(0.75)
    assert result["against_baseline"]["nff"]["outer"]["position_error_change"] == pytest.approx(-0.75)
    assert result["intervals"]["nff"]["position_error_before_m"][0] == pytest.approx(0.5)
    assert result["intervals"]["nff"]["false_loss"] == [0.0, 0.0, 0.0]
    lost = traces[-1].case.motor
    traces[-1].effectiveness[500, [lost - 1, lost % 8]] = 0.0, 0.25
    assert figures.false_loss(traces[-1]) == 0.75, "the motor that was lost does not count"
    json.dumps(result, allow_nan=False)


@pytest.mark.parametrize(
    ("feed", "law", "fed"),
    [(None, "nff", True), (None, "baseline", False), (True, "baseline", True), (False, "nff", False)],
)
def test_the_lateral_force_is_fed_forward_to_whom_the_parts_say(feed: bool | None, law: str, fed: bool) -> None:
    parts = LAWS[law] if feed is None else dataclasses.replace(LAWS[law], feed_lateral=feed)
    flight = VirtualFlight(
        make_fleet(DemoOptions(failures=[], wind_m_s=6.0)),
        {0: TrialOptions(mode=Mode.OVERRIDE, parts=parts)},
        airframe="octo-x",
    )
    while flight.fleet.time_s < 4.0:
        flight.step()
    known = flight.companions[0].session.state.knowledge
    assert bool(known.push_m_s2.any()) == fed
    assert bool(known.residual.any()) == (law == "nff")


def test_the_adapted_matrix_learns_a_lost_motor_and_begins_anew(octo: Vehicle) -> None:
    adapted = AdaptedMatrix(octo)
    state, nominal = adapted.allocation(adapted.start(), np.zeros((8, 4)))
    lost = -0.5 * octo.acceleration_effectiveness[:, 2] * octo.hover
    estimate = cast("Estimate", SimpleNamespace(thrust_shown=np.full(8, octo.hover), raw=lost))  # all that it reads
    for _ in range(200):
        state = adapted.step(state, estimate, 0.005)
    _, learnt = adapted.allocation(state, nominal)
    assert not np.allclose(learnt, nominal)
    np.testing.assert_allclose(adapted.allocation(adapted.start(), np.zeros((8, 4)))[1], nominal)


@pytest.mark.parametrize(
    "wrong", [{"follow_s": 0.0}, {"follow_s": -1.0}, {"forget_per_s": 1000.0}, {"composite": -1.0}]
)
def test_an_adaptation_that_would_run_away_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(wrong, AdaptationTuning)
