"""Numbers that turn a residual into declarations: onsets, hypotheses, thresholds, rotor speeds.

What the reasons call measured is explained in estimation.py.
"""

from __future__ import annotations

from typing import Annotated

import msgspec

from nff_companion.core.tuning.span import PerAxis, about, span

Age = Annotated[float, msgspec.Meta(ge=0.005, le=1.0)]
Ages = tuple[Age, Age, Age, Age, Age, Age, Age, Age, Age, Age, Age, Age]


class OnsetTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Matched filters for a sudden loss, one for each possible onset (core/onset.py)."""

    ages_s: Annotated[
        Ages, about("s", "ages of the onsets compared: dense where a loss begins to show, the last one is the memory")
    ] = (0.01, 0.015, 0.02, 0.03, 0.04, 0.05, 0.065, 0.08, 0.1, 0.13, 0.16, 0.2)
    standing_s: Annotated[
        tuple[Age, Age], about("s", "windows for a loss that is older than the memory: in full all along")
    ] = (0.1, 0.2)
    gamma_onset: Annotated[
        float,
        span(0.0, 50.0, "nats", "weight of the l1 norm for the onsets: small, they are judged by their likelihood"),
    ] = 1.0
    model_error_share: Annotated[
        float,
        span(0.0, 1.0, "", "of y itself that is no evidence: a large torque must not drown what the other axes say"),
    ] = 0.10
    together_error_share: Annotated[
        PerAxis,
        about(
            "",
            "of what all motors do beyond their steady part: inertia and thrust are 10 % wrong, the ratio of torque to"
            " thrust by up to a half",
        ),
    ] = (0.12, 0.12, 0.12, 0.35)
    single_error_share: Annotated[
        float,
        span(
            0.0, 1.0, "", "of what each does for itself: in forward flight a rotor in another's wake gives a fifth less"
        ),
    ] = 0.12
    yaw_error_share: Annotated[
        float, span(0.0, 1.0, "", "yaw torque not modelled, over roll and pitch torque, besides the side drag")
    ] = 0.02


class DecisionTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When a motor is declared failed, and when that is lifted (core/decision.py).

    Chosen on healthy forward flights and single failures of seeds 1 to 48, confirmed on 49 to 72 (docs/learning.md).
    """

    improvement_min: Annotated[
        float,
        span(8.0, 200.0, "nats", "over no failure: the mean time between false alarms grows as its exponential"),
    ] = 18.0
    margin_min: Annotated[
        float, span(2.0, 100.0, "nats", "over the next hypothesis: a wrong motor taken off is worse than none")
    ] = 6.0
    margin_share: Annotated[
        float,
        span(
            0.0,
            0.5,
            "",
            "of what is explained, that the lead must be besides: less is the model's error, and not known which it is."
            " Of 224 pairs by a calibrated file 3 of the 4 wrong ones led by 0.009 to 0.014",
        ),
    ] = 0.025
    among_after_s: Annotated[
        float, span(0.0, 5.0, "s", "of motors that cannot be told apart, after which they are said as a set")
    ] = 0.15
    among_size_s: Annotated[
        float,
        span(
            0.0, 10.0, "s", "of a set, after which one of it is told by how the residual moves, no longer by its size"
        ),
    ] = 0.5
    among_hold_s: Annotated[
        float, span(0.05, 10.0, "s", "for which a set outlives what shows it: a moment in which one of them leads")
    ] = 1.0
    second_look_s: Annotated[
        float, span(0.0, 0.2, "s", "after a declaration, in which it is taken back where something else explains all")
    ] = 0.12
    doubted_s: Annotated[
        float,
        span(0.0, 60.0, "s", "after it was taken back, in which no window names a motor alone again: no flapping"),
    ] = 5.0
    moved_margin_min: Annotated[
        float,
        span(2.0, 100.0, "nats", "over the next of a set, and over none, by how the residual moves with the motors"),
    ] = 8.0
    among_block_s: Annotated[
        float, span(0.1, 5.0, "s", "of flight whose mean is no evidence in telling a set apart: as long as a test")
    ] = 0.24
    among_refuted_min: Annotated[
        float,
        span(
            5.0,
            500.0,
            "nats",
            "that none of a set is lost is ahead of each of it, by how the residual moves: it is the file then, and"
            " learnt. Of an octorotor that began to climb with a file guessed it was ahead by 80",
        ),
    ] = 10.0
    more_improvement_min: Annotated[
        float, span(8.0, 500.0, "nats", "over no failure, by which a motor is said to pull more than it is asked to")
    ] = 60.0
    more_min: Annotated[float, span(0.05, 0.9, "", "of its full thrust, that it pulls more: gusts look like less")] = (
        0.3
    )
    alike_max: Annotated[int, span(2, 28, "sets", "that are said at most, the best first")] = 4
    pair_min: Annotated[
        float, span(1.0, 100.0, "nats", "that only a second motor brings: a pair explains more of anything")
    ] = 6.0
    pair_sudden_s: Annotated[
        float,
        span(0.2, 60.0, "s", "of suspicion, after which two motors are told by what moves: a sagging battery took 7 s"),
    ] = 1.0
    explained_min: Annotated[
        float, span(0.5, 0.99, "", "share of the residual's energy that is explained: the rest would be something else")
    ] = 0.70
    shared_explained_min: Annotated[
        float,
        span(0.5, 0.99, "", "the same by a pair of which one motor is named: of a tumbling quadrotor a pair made 0.72"),
    ] = 0.80
    partial_loss_min: Annotated[
        float, span(0.05, 0.6, "", "least loss of a motor that is told to have lost a part of its thrust")
    ] = 0.15
    partial_explained_min: Annotated[
        float, span(0.5, 0.99, "", "share of the residual's energy that it explains: air explains less")
    ] = 0.80
    partial_lift_min: Annotated[
        float,
        span(
            0.0, 30.0, "nats", "that the thrust axis alone says of it: of 60 loads that slid by guessed files, 11 would"
        ),
    ] = 3.0
    partial_again_share: Annotated[
        float, span(0.05, 0.45, "", "of a loss that is told, that is left when the motor works again")
    ] = 0.25
    partial_again_s: Annotated[
        float, span(0.1, 2.0, "s", "in which most of it has gone then: what is learnt goes more slowly")
    ] = 0.6
    partial_confirm_s: Annotated[float, span(0.0, 5.0, "s", "for which it must explain so much")] = 0.1
    look_share: Annotated[
        float, span(0.1, 1.0, "", "of improvement_min from which a hypothesis is looked at, and learning is frozen")
    ] = 0.5
    loss_sudden: Annotated[
        float, span(0.3, 0.95, "", "least loss of each motor named, by the onset windows: gusts look like smaller ones")
    ] = 0.62
    place_loss_min: Annotated[
        float,
        span(
            0.0,
            0.95,
            "",
            "least loss of either of two motors above each other, for one of them to be lost: while the vehicle turned,"
            " 0.2 of the one, which had lost 0.3, was all that the other gave",
        ),
    ] = 0.4
    loss_settled: Annotated[
        float,
        span(
            0.3,
            0.98,
            "",
            "least mean loss where the onset is old enough to know it well, and of two at once: partly lost, two motors"
            " can look like any gust",
        ),
    ] = 0.78
    settled_s: Annotated[float, span(0.02, 0.5, "s", "age from which an onset's loss is known well")] = 0.095
    loss_gradual: Annotated[
        float, span(0.3, 0.95, "", "least loss by the sparse estimate, 1 - xi, where no onset was seen")
    ] = 0.72
    loss_others: Annotated[
        float,
        span(
            0.05,
            0.9,
            "",
            "of a second motor, beside which nothing gradual is declared, nor one named alone: that is unknown air",
        ),
    ] = 0.30
    deviation_gradual_max: Annotated[
        float, span(0.01, 1.0, "", "of the sparse estimate, to declare a gradual loss by it")
    ] = 0.25
    confirm_s: Annotated[
        float, span(0.0, 0.5, "s", "a single motor must lead for so long: one or two samples, one may be a shock")
    ] = 0.008
    confirm_gradual_s: Annotated[
        float, span(0.05, 5.0, "s", "a gradual loss must last so long: there is time, it has grown slowly")
    ] = 0.3
    confirm_ambiguous_s: Annotated[
        float, span(0.0, 1.0, "s", "a pair must lead for so long: it has more look-alikes")
    ] = 0.015
    confirm_shared_s: Annotated[
        float, span(0.0, 1.0, "s", "a motor must be in all pairs that explain well for so long, where none does alone")
    ] = 0.05
    mates_alike: Annotated[
        float,
        span(
            0.9, 1.0, "", "cosine of what two motors do to thrust, roll, pitch, from which they are at the same place"
        ),
    ] = 0.995
    mates_sure: Annotated[
        float,
        span(0.5, 10.0, "deviations", "of yaw, by which one of two motors above each other is told from the other"),
    ] = 1.7
    failed_max: Annotated[
        int, span(1, 6, "motors", "declared at once; more is a fault of the model or of the telemetry")
    ] = 4
    lift_effectiveness: Annotated[
        float, span(0.5, 1.0, "", "from which a declared motor counts as working: well above what declares it")
    ] = 0.8
    driven: Annotated[
        float, span(0.02, 0.5, "", "thrust fraction that counts as driven: at rest the data say nothing of a motor")
    ] = 0.15
    lift_s: Annotated[
        float, span(0.1, 60.0, "s", "of such evidence: longer than any declaration takes, so that nothing toggles")
    ] = 1.5
    deviation_lift_max: Annotated[float, span(0.01, 1.0, "", "of the free coefficient, to lift by it")] = 0.15
    direct_min: Annotated[
        float, span(1.0, 100.0, "nats", "improvement where rotor speeds already name the motors: the residual agrees")
    ] = 4.0
    direct_behind: Annotated[float, span(0.0, 20.0, "nats", "by which another hypothesis may be better then")] = 3.0
    direct_loss_share: Annotated[
        float, span(0.1, 1.0, "", "of loss_sudden that is enough where rotor speeds name the motors")
    ] = 0.5


class EstimatorTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is asked when, and how fast is learnt meanwhile (core/estimator.py)."""

    suspicious: Annotated[
        float, span(0.5, 10.0, "deviations", "of y on one axis from which hypotheses are compared: time of the CPU")
    ] = 3.0
    learn_fast_s: Annotated[
        float, span(0.0, 10.0, "s", "after the start of a flight the disturbance is learnt quickly")
    ] = 1.0
    learn_fast_rate: Annotated[float, span(1.0, 50.0, "", "speed of learning then, over the usual")] = 6.0
    quiet: Annotated[
        float, span(0.2, 3.0, "deviations", "of y on every axis, within which the start of a flight is learnt")
    ] = 2.0
    quiet_s: Annotated[
        float, span(0.0, 2.0, "s", "of that: then a failure early in the flight is not learnt away quickly")
    ] = 0.1
    begin_s: Annotated[
        float, span(0.0, 0.5, "s", "of a flight: what is off in them is off by the file, and is no failure of a motor")
    ] = 0.04
    begin_rate: Annotated[float, span(1.0, 500.0, "", "speed of learning in them, over the usual")] = 100.0
    freeze_max_s: Annotated[
        float, span(0.05, 10.0, "s", "learning stands while a failure is weighed, for no longer: it may be the air")
    ] = 1.0
    sure_explained: Annotated[
        float,
        span(0.5, 1.0, "", "what a few motors explain this well is theirs, though they may not be told apart yet"),
    ] = 0.9
    freeze_sure_s: Annotated[float, span(0.05, 60.0, "s", "and is not learnt for as long as this")] = 8.0
    doubtful_rate: Annotated[
        float, span(0.0, 1.0, "", "speed of learning after that, over the usual, while the doubt lasts")
    ] = 0.3
    steady_s: Annotated[float, span(0.05, 5.0, "s", "what the motors do for longer than this is steady flight")] = 0.4
    clear_loss: Annotated[
        float, span(0.01, 0.9, "", "loss by the sparse estimate that counts as one, and is kept from phi a")
    ] = 0.12
    few: Annotated[int, span(1, 6, "motors", "with such a loss at most: more is a disturbance, and is learnt")] = 2


class RotorSpeedTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which driven motors stand still, by telemetry that has proven itself (core/rotor_speed.py).

    Shares are of the speed that the motor's own history leads one to expect.
    """

    driven: Annotated[float, span(0.01, 0.5, "", "thrust fraction below which a motor may stand still")] = 0.05
    stopped_share: Annotated[
        float, span(0.05, 0.9, "", "below it a rotor counts as stopped: an eighth of the thrust is left")
    ] = 0.35
    turning_share: Annotated[float, span(0.1, 0.95, "", "above it a rotor turns and its history is learnt")] = 0.5
    turning_min_rad_s: Annotated[float, span(0.1, 100.0, "rad/s", "below it nothing turns, whatever the share")] = 1.0
    unlike_share: Annotated[
        float,
        span(0.1, 2.0, "", "off the median of all motors: all are of one kind, this is another sender or nonsense"),
    ] = 0.6
    fresh_s: Annotated[float, span(0.01, 1.0, "s", "older readings say nothing")] = 0.1
    frozen_s: Annotated[float, span(0.05, 5.0, "s", "the same reading for so long: the sender has stopped")] = 0.4
    proven_s: Annotated[float, span(0.1, 60.0, "s", "of good readings, to be believed")] = 1.0
    ratio_s: Annotated[float, span(0.05, 10.0, "s", "time constant of the expected speed")] = 0.5
    step_max_s: Annotated[
        float, span(0.005, 1.0, "s", "longest interval counted between two samples: a gap proves nothing")
    ] = 0.05
    readings: Annotated[int, span(1, 20, "readings", "in a row that say stopped: one may be lost or garbled")] = 2
    at_once_max: Annotated[int, span(1, 6, "motors", "stopping together; more: it is the telemetry")] = 2
    fault_s: Annotated[
        float, span(0.1, 10.0, "s", "stopped by telemetry, pulling by the residual, for so long: a fault of the sensor")
    ] = 0.5
