"""The control law: it points the right way, and saturation serves roll and pitch before yaw."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from nff_companion.control.law import ControlLaw, Knowledge, Memory, Reference, State, steady_push
from nff_companion.core.vehicle import Vehicle

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
STILL = np.zeros(3)


def demand(
    octo: Vehicle,
    *,
    position: ArrayLike = STILL,
    velocity: ArrayLike = STILL,
    quaternion: NDArray[np.float64] = LEVEL,
    rate: ArrayLike = STILL,
    disturbance: ArrayLike | None = None,
    yaw: float = 0.0,
) -> NDArray[np.float64]:
    state = State(np.asarray(position, float), np.asarray(velocity, float), quaternion, np.asarray(rate, float))
    wanted = Reference(np.zeros(3), np.zeros(3), yaw)
    slow = np.zeros(4) if disturbance is None else np.asarray(disturbance, float)
    return ControlLaw(octo).demand(state, wanted, Memory(), Knowledge(slow, np.zeros(2)), 0.005)[0]


def test_at_rest_in_place_it_asks_for_the_weight_and_nothing_else(octo: Vehicle) -> None:
    np.testing.assert_allclose(demand(octo), [octo.hover, 0, 0, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("change", "axis", "sign"),
    [
        ({"position": [-1, 0, 0]}, 2, -1),  # south of the goal: nose down
        ({"position": [0, -1, 0]}, 1, 1),  # west of the goal: roll right
        ({"position": [0, 0, 1]}, 0, 1),  # below the goal: more thrust
        ({"velocity": [1, 0, 0]}, 2, 1),  # going north: nose up
        ({"rate": [0.5, 0, 0]}, 1, -1),
        ({"rate": [0, 0.5, 0]}, 2, -1),
        ({"rate": [0, 0, 0.5]}, 3, -1),
        ({"yaw": 0.5}, 3, 1),
        ({"disturbance": [0, 2.0, 0, 0]}, 1, -1),  # what already rolls it is taken off (6.18)
        ({"disturbance": [1.0, 0, 0, 0]}, 0, -1),
    ],
)
def test_each_error_is_answered_with_the_right_sign(
    octo: Vehicle, change: dict[str, Any], axis: int, sign: int
) -> None:
    difference = demand(octo, **change) - demand(octo)
    assert np.sign(difference[axis]) == sign
    others = np.delete(np.abs(difference), axis)
    assert abs(difference[axis]) > 0.0
    if axis:
        assert others[1:].max(initial=0.0) < 1e-9 + 0.2 * abs(difference[axis])


def test_a_tilted_vehicle_is_turned_back_whatever_its_heading(octo: Vehicle) -> None:
    for yaw in np.linspace(-3, 3, 7):
        tilt = np.array([math.cos(0.2), math.sin(0.2), 0, 0])  # rolled right by 0.4 rad
        turn = np.array([math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)])
        w, x, z = turn[0] * tilt[0], turn[0] * tilt[1], turn[3] * tilt[0]
        answer = demand(octo, quaternion=np.array([w, x, turn[3] * tilt[1], z]), yaw=float(yaw))
        assert answer[1] < -0.01
        assert abs(answer[2]) < 0.3 * abs(answer[1])


def test_the_push_of_a_leaning_hover_is_where_it_leans(octo: Vehicle) -> None:
    lean = np.array([math.cos(-0.05), 0, math.sin(-0.05), 0])  # nose down: pushes forward (north)
    push = steady_push(lean, np.array([0, 0, -9.8]))
    assert push[0] == pytest.approx(9.8 * math.sin(0.1), rel=1e-6)
    assert push[1:] == (0.0, 0.0)


def test_whatever_is_measured_or_believed_the_attitude_wanted_is_upright(
    octo: Vehicle, rng: np.random.Generator
) -> None:
    law = ControlLaw(octo)
    for _ in range(2000):
        quaternion = rng.standard_normal(4)
        quaternion /= np.linalg.norm(quaternion)
        position, velocity = (rng.uniform(-1, 1, 3) * s for s in (500.0, 50.0))
        state = State(position, velocity, quaternion, rng.uniform(-60, 60, 3))
        wild = Knowledge(rng.uniform(-50, 50, 4), rng.uniform(-400, 400, 2))
        position, velocity = (rng.uniform(-1, 1, 3) * s for s in (500.0, 50.0))
        reference = Reference(position, velocity, 1.0, rng.uniform(-50, 50, 3))
        asked, memory = law.demand(state, reference, Memory(), wild, 0.005)
        assert np.isfinite(asked).all()
        assert memory.desired is not None
        assert memory.desired[2][2] >= math.cos(math.radians(30.1)), "body z points down within the largest tilt"


@pytest.mark.parametrize("axis", range(4))
def test_what_is_known_of_an_axis_is_taken_off_in_full(octo: Vehicle, axis: int) -> None:
    """(6.18): the demand falls by phi a, in the demand's units, on each axis alike."""
    known = np.eye(4)[axis]
    expected = -octo.normalised_per_acceleration[axis] * known
    np.testing.assert_allclose(demand(octo, disturbance=known) - demand(octo), expected, atol=1e-12)


def test_a_tumbling_vehicle_is_never_asked_for_negative_thrust(octo: Vehicle) -> None:
    """The floor is on what the motors give, after what is known of the residual is taken off."""
    upside_down = np.array([0.0, 1.0, 0.0, 0.0])
    for known in (0.0, 3.0, 8.0, 30.0):
        answer = demand(octo, quaternion=upside_down, disturbance=[known, 0, 0, 0])
        assert answer[0] >= 0.1 * octo.hover
