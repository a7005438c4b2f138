"""Numbers that turn telemetry into a residual, and a residual into what is believed of each motor.

"Measured" in a reason refers to the simulated flights of docs/learning.md and to the recorded ones of README, Data;
where nothing is said of a measurement the value was set by judgement and kept, because those flights came out well.
"""

from __future__ import annotations

from typing import Annotated

import msgspec

from nff_companion.core.tuning.span import PerAxis, about, span


class ResidualTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The residual y from gyro, accelerometer and commands (core/residual.py)."""

    smoothing_s: Annotated[
        float,
        span(0.001, 0.1, "s", "lag behind the differentiated gyro, whose noise grows with the sample rate; all delay"),
    ] = 0.008
    lateral_s: Annotated[
        float, span(0.01, 2.0, "s", "smoothing of the lateral specific force that the rotors' side drag is taken from")
    ] = 0.15
    idle: Annotated[
        float, span(0.001, 0.2, "", "least thrust fraction of a rotor that turns: its share of the drag never vanishes")
    ] = 0.02


class DisturbanceTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the model does not expect and no motor explains, and how noisy y is (core/disturbance.py)."""

    spread_s: Annotated[
        float,
        span(0.5, 60.0, "s", "memory of the residual's variance: longer than a failure, shorter than a gust front"),
    ] = 4.0
    spread_limit: Annotated[
        float, span(1.0, 10.0, "", "deviations one sample counts at most: a fault must not become usual")
    ] = 3.0
    spread_step_max: Annotated[
        float, span(0.01, 1.0, "", "largest share by which one sample, however late, may move the variance")
    ] = 0.5
    floor_share: Annotated[
        PerAxis,
        about(
            "",
            "least deviation, over what the loss of one motor gives at hover: errors of mass, inertia, lag scale with"
            " the thrusts and never show while flying steadily",
        ),
    ] = (0.30, 0.07, 0.07, 0.20)
    floor: Annotated[
        PerAxis, about("m/s^2, rad/s^2", "least deviation by the sensors alone, however small the vehicle's losses are")
    ] = (0.20, 0.35, 0.35, 0.10)
    mean_share_max: Annotated[
        PerAxis,
        about(
            "",
            "most that phi a may learn in a flight, over the loss of one motor: a vehicle that starts with a failure"
            " must show it",
        ),
    ] = (2.5, 0.40, 0.40, 1.5)
    ceiling_share: Annotated[
        PerAxis, about("", "largest deviation believed, over the loss of one motor: noise may not hide a failure")
    ] = (1.0, 0.35, 0.35, 1.0)
    correlation_s: Annotated[
        float, span(0.005, 0.2, "s", "of y after its filters: samples closer than this are not independent evidence")
    ] = 0.025
    stale_s: Annotated[
        float,
        span(0.1, 20.0, "s", "without attitude or velocity phi fades to the constant: a jump would look like a loss"),
    ] = 2.0
    share_prior: Annotated[
        float, span(0.0, 1.2, "", "share of the lateral drag that acts at the rotors, before any of it was seen")
    ] = 0.5
    share_prior_deviation: Annotated[
        float, span(0.01, 1.0, "", "how uncertain that share is before and, at most, in flight")
    ] = 0.35
    share_doubt: Annotated[
        float,
        span(
            0.0,
            1.0,
            "",
            "deviation of that share however long it was learnt: in flights of 12 m/s it came out at 0.0 to 1.1, each"
            " time to 0.03 to 0.08, and two motors that work were declared for the one between them",
        ),
    ] = 0.1
    share_max: Annotated[
        float,
        span(0.5, 2.0, "", "largest share believed: rotors drag the most of it, a little more by errors of the arms"),
    ] = 1.2
    share_drift_per_s: Annotated[
        float, span(0.0, 0.01, "1/s", "growth of that share's variance: it changes with the air speed, in minutes")
    ] = 2e-5


class BalanceTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What flight shows of lift, centre of mass and gains (core/balance.py); deviations of a file's numbers."""

    lift_deviation: Annotated[
        float, span(0.001, 1.0, "", "of what the motors lift, as a share: mass, full thrust, thrust curve at hover")
    ] = 0.15
    centre_deviation: Annotated[
        float, span(0.0001, 0.5, "", "of the centre of mass from the middle of the rotors, over the longest arm")
    ] = 0.03
    yaw_deviation: Annotated[
        float, span(0.001, 5.0, "", "of the yaw torque of all motors together, over that of one motor at hover")
    ] = 0.15
    deviations_max: Annotated[
        float, span(0.5, 10.0, "deviations", "of each, at most: what is beyond is not the file's error")
    ] = 3.0
    quickest_s: Annotated[
        float,
        span(0.1, 10.0, "s", "time constant at the start of a flight: a motor that fails then is not learnt away"),
    ] = 0.3
    drift_s: Annotated[
        float,
        span(10.0, 1e9, "s", "in which each could change by its deviation: what is learnt slower is no failure"),
    ] = 1e6
    gain_per_s: Annotated[
        float, span(0.001, 10.0, "1/s", "by which the factor of a row follows what the flight shows of it")
    ] = 0.3


class CurveTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What flight on fewer motors shows of the thrust curve (core/curve.py)."""

    bend_deviation: Annotated[
        float,
        span(0.001, 2.0, "", "of a file's curve: expo off by 0.3 and idle by 0.06 bend it by 0.4 to 1.1"),
    ] = 0.3
    deviations_max: Annotated[
        float, span(0.5, 10.0, "deviations", "at most: what is beyond is not the file's error")
    ] = 3.0
    quickest_s: Annotated[
        float, span(0.1, 10.0, "s", "time constant: a second motor that fails is named before it is learnt away")
    ] = 0.3
    drift_s: Annotated[
        float,
        span(0.5, 1e9, "s", "in which it is as little known as before: in hover errors of other kinds look like it"),
    ] = 10.0


class AdaptationTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The Kalman filter of a in phi a (core/adaptation.py). R is 1 in the axes' own scale: only ratios matter."""

    follow_s: Annotated[
        float,
        span(0.05, 60.0, "s", "time constant of a basis function of value 1, sqrt(R / Q): faster explains motors away"),
    ] = 2.0
    forget_per_s: Annotated[
        float, span(0.0, 1.0, "1/s", "lambda, decay towards a0; 0: what a flight has taught stays for the flight")
    ] = 0.0
    composite: Annotated[
        float, span(0.0, 10.0, "", "weight of the tracking error in the law of a; 0: by prediction alone, as it flies")
    ] = 0.0
    covariance_growth: Annotated[
        float,
        span(1.0, 100.0, "", "trace of P over that at the start: directions not excited gather variance for ever"),
    ] = 2.0
    step_max_s: Annotated[
        float, span(0.01, 2.0, "s", "longest interval learnt from in one step, after a gap or in the fast start")
    ] = 0.5


class NetworkTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The basis network in flight (core/basis_network.py)."""

    contraction_max: Annotated[
        float, span(0.1, 1.0, "", "bound of sigma(A) Lip_u(phi) |a|: at 1 the fixed point (6.7) is no longer certain")
    ] = 1.0
    drag_m_s2: Annotated[
        float,
        span(
            0.1, 20.0, "m/s^2", "where none is trained: lateral force by which its effect is learnt like the constant"
        ),
    ] = 1.0
    contraction_kept: Annotated[
        float, span(0.5, 0.9999, "", "share of that bound that a is shortened to, so that rounding does not break it")
    ] = 0.999
    outside_share: Annotated[
        float,
        span(
            0.0, 1.0, "", "of the training range, by which inputs may leave it: a network says nothing beyond its data"
        ),
    ] = 0.15


class SparseTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The sparse effectiveness, laws (23) and (8) (core/sparse.py)."""

    forgetting_per_s: Annotated[
        float, span(0.5, 100.0, "1/s", "w_f: partial losses are found in an eighth of a second, gusts average out")
    ] = 8.0
    gamma: Annotated[
        float, span(1.0, 200.0, "nats", "weight of the l1 norm: without it losses are believed of motors that work")
    ] = 20.0
    solve_interval_s: Annotated[
        float, span(0.001, 0.1, "s", "between solutions of the program, whose sums take every sample: time of the CPU")
    ] = 0.01
    prior_deviation: Annotated[
        float, span(0.1, 10.0, "", "of a loss nothing is known of: with 1, a motor without data is as good as unknown")
    ] = 1.0
    free_max: Annotated[
        float, span(1.0, 2.0, "", "largest effectiveness that a declared motor's free coefficient is read as")
    ] = 1.2


class SlidLoadTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When what looks like a partial loss is a load that slid (core/slid_load.py)."""

    nats_min: Annotated[
        float,
        span(
            0.5,
            50.0,
            "nats",
            "by which no loss must be likelier by the lift alone. One second after a load slid by a twentieth of the"
            " arm the lift was 0 to 0.3 of what the loss seen would take away, after losses of 30 to 50 % 0.5 to 1.4",
        ),
    ] = 2.0
    forgetting_per_s: Annotated[
        float, span(0.05, 10.0, "1/s", "of the lift seen: gusts average out, and what was wrong at first goes")
    ] = 0.5
    hold_s: Annotated[
        float, span(0.0, 10.0, "s", "without a loss seen, after which the next one is looked at anew")
    ] = 0.1
    grown_by: Annotated[
        float, span(0.02, 1.0, "", "that a loss is larger than when it was first seen: then it is another one")
    ] = 0.1


class SampleRateTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """At which rate samples really come (core/sample_rate.py)."""

    off_share: Annotated[
        float, span(0.02, 0.5, "", "off the rate that the estimator is built for: more, and it only observes")
    ] = 0.10
    same_share: Annotated[
        float, span(0.001, 0.1, "", "off it between flights: less is jitter, for more the estimator is built anew")
    ] = 0.01
    intervals: Annotated[
        int, span(20, 1000, "intervals", "of which the median counts: steady under jitter and losses of a third")
    ] = 100
    intervals_least: Annotated[int, span(5, 500, "intervals", "before anything is said of the rate")] = 20
