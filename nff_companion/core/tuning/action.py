"""Numbers that turn what is believed of the motors into a matrix, thrusts, and the right to send them."""

from __future__ import annotations

from typing import Annotated

import msgspec

from nff_companion.core.tuning.span import about, span

Priority = Annotated[float, msgspec.Meta(ge=1e-3, le=10.0)]


class FlightPhaseTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Is the vehicle in free flight? (core/flight_phase.py) Thrust shares are of the hover thrust by its mass."""

    height_m: Annotated[float, span(0.1, 20.0, "m", "above where it was armed: below, the ground may push")] = 0.7
    thrust_share: Annotated[float, span(0.3, 1.2, "", "from which the motors may be carrying the vehicle")] = 0.7
    sure_after_s: Annotated[float, span(0.05, 10.0, "s", "with height and thrust")] = 0.5
    lifted_m: Annotated[
        float,
        span(0.02, 5.0, "m", "above where it was armed, beyond what tipping over lifts it: then a climb is flight"),
    ] = 0.05
    lifted_climb_m_s: Annotated[
        float, span(0.05, 5.0, "m/s", "of that climb: more than the estimate of what stands has wrong")
    ] = 0.25
    lifted_tilt_deg: Annotated[float, span(1.0, 45.0, "deg", "of what climbs, at most")] = 15.0
    lifted_after_s: Annotated[float, span(0.0, 5.0, "s", "of such a climb")] = 0.04
    assumed_after_s: Annotated[
        float, span(0.1, 60.0, "s", "with thrust alone: no height is known, or a restart in flight")
    ] = 2.0
    told_after_s: Annotated[
        float, span(0.02, 10.0, "s", "after a restart in flight, with the autopilot's word that it flies, and thrust")
    ] = 0.2
    ended_share: Annotated[float, span(0.02, 0.8, "", "thrust below which a flight may have ended")] = 0.3
    ended_after_s: Annotated[float, span(0.05, 10.0, "s", "of so little thrust: a quick descent is shorter")] = 0.5
    impact_share: Annotated[
        float, span(1.0, 5.0, "", "specific force over what all motors can give, beyond which something was hit")
    ] = 1.3
    impact_m_s2: Annotated[float, span(1.0, 200.0, "m/s^2", "and this much more: noise and gusts stay below")] = 10.0
    impact_samples: Annotated[int, span(1, 50, "samples", "in a row: one may be a shock, or noise")] = 3
    impact_below_m: Annotated[
        float, span(0.5, 100.0, "m", "above the ground: higher up there is nothing to stand on")
    ] = 3.0


class PlannerTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When a matrix is computed, for which motors, and which may be sent (allocation/)."""

    shape_full_at: Annotated[float, span(0.3, 1.0, "", "zeta of (24): from here a motor counts as whole")] = 0.75
    shape_none_below: Annotated[float, span(0.05, 0.9, "", "xi of (24): below it a motor counts as gone")] = 0.30
    deviation_max: Annotated[
        float, span(0.01, 1.0, "", "of the sparse estimate, to allocate around a partial loss by it")
    ] = 0.2
    partial_min: Annotated[
        float,
        span(0.05, 0.5, "", "least effectiveness of a motor that is not declared: it is used less, never removed"),
    ] = 0.1
    degraded_for_s: Annotated[
        float, span(0.0, 10.0, "s", "a partial loss is allocated around after this long: a gust is shorter")
    ] = 0.2
    partial_hold_s: Annotated[
        float, span(0.0, 60.0, "s", "in which what is allocated around of a motor neither comes nor goes again")
    ] = 5.0
    partial_pause_s: Annotated[
        float, span(0.01, 1.0, "s", "between two samples, after which a loss seen before does not count as lasting")
    ] = 0.1
    partial_over_s: Annotated[
        float, span(0.0, 10.0, "s", "without a part lost, after which the motor counts as whole again")
    ] = 0.5
    resolve_change: Annotated[
        float, span(0.005, 0.5, "", "of a motor's effectiveness, to compute a new matrix: less is noise")
    ] = 0.08
    resolve_interval_s: Annotated[
        float, span(0.01, 5.0, "s", "between matrices without a declaration; the published allocation runs at 10 Hz")
    ] = 0.1
    catch_s: Annotated[
        float, span(0.0, 20.0, "s", "after a double failure roll and pitch have more right to torque than yaw")
    ] = 2.0
    double_within_s: Annotated[float, span(0.0, 5.0, "s", "two declarations within this time are a double failure")] = (
        0.5
    )
    attitude_authority_min: Annotated[
        float, span(0.02, 0.5, "", "share of full roll or pitch torque left at hover, below which yaw is given up")
    ] = 0.05
    catch_authority_min: Annotated[
        float, span(0.02, 0.8, "", "the same while the vehicle is still being caught: it needs more")
    ] = 0.15
    authority_floor: Annotated[
        float, span(0.001, 0.2, "", "below this nothing is left to fly with, yaw given up or not: no matrix is sent")
    ] = 0.01
    axis_authority_min: Annotated[
        float, span(1e-4, 0.1, "", "torque share of an axis, below which the linear program has none to normalise by")
    ] = 1e-3
    removed_below: Annotated[
        float, span(0.02, 0.5, "", "effectiveness at which a column is removed instead of scaled: gains would explode")
    ] = 0.1
    gain_max: Annotated[
        float,
        span(1.5, 20.0, "", "largest entry of A sent; 1 is the healthy octorotor's, with two dead it stays below 3"),
    ] = 6.0
    carry_steps: Annotated[
        int, span(1, 20, "steps", "in which less is carried over to the autopilot where motors would leave their range")
    ] = 4
    identity_tolerance: Annotated[float, span(1e-9, 1e-3, "", "largest entry of B A - I of a matrix that is sent")] = (
        1e-6
    )


class HandoverTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a matrix is given over to an autopilot that has long made up for the motor (allocation/handover.py)."""

    wind_up_s: Annotated[
        float, span(0.05, 5.0, "s", "twice, in which the autopilot's integrators make up for what motors lack")
    ] = 0.08
    let_go_s: Annotated[float, span(0.1, 20.0, "s", "in which they follow when that is let go")] = 5.0
    refresh_s: Annotated[float, span(0.01, 0.5, "s", "between two matrices while it is let go: as they are told")] = (
        0.048
    )
    holds_s: Annotated[
        float, span(0.0, 5.0, "s", "that a matrix holds in the autopilot which is no longer told: then it is forgotten")
    ] = 0.5
    least: Annotated[float, span(1e-4, 0.1, "", "of an axis' full torque: less than this is let go at once")] = 0.004
    known_min: Annotated[
        float, span(0.01, 1.0, "", "of the lag, that must have been seen: before, noise would be taken for it")
    ] = 0.1


class OverrideTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Thrusts within their bounds (allocation/within_bounds.py, control/override.py)."""

    priority: Annotated[
        tuple[Priority, Priority, Priority, Priority],
        about(
            "", "weight of an axis' error, thrust, roll, pitch, yaw: heading is what can be done without for longest"
        ),
    ] = (0.2, 1.0, 1.0, 0.03)
    close_to_matrix: Annotated[
        float, span(1e-8, 1e-2, "", "weight of staying with A: decides among thrusts that serve equally well")
    ] = 1e-5
    thrust_raise_max: Annotated[
        float, span(0.0, 1.0, "", "of the thrust asked for, by which it is raised to keep motors from idling out")
    ] = 0.3
    served_error: Annotated[
        float, span(1e-9, 1e-2, "", "of an axis' full torque: less than this missing is no saturation")
    ] = 1e-6


class LawTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The control law of the override (control/law.py)."""

    tilt_max_deg: Annotated[float, span(5.0, 60.0, "deg", "of the thrust from the vertical")] = 30.0
    position_error_max_m: Annotated[
        float, span(0.5, 50.0, "m", "that is acted on: further away the speed of approach is bounded")
    ] = 4.0
    vertical_max_m_s2: Annotated[
        float, span(0.5, 9.0, "m/s^2", "vertical acceleration asked for: below gravity, thrust stays upward")
    ] = 4.0
    drag_max_m_s2: Annotated[
        float,
        span(0.0, 20.0, "m/s^2", "fed forward along each axis: more is no air, but a blow or a fault of the sensor"),
    ] = 5.0
    integral_per_s: Annotated[float, span(0.0, 5.0, "1/s", "of the position loop's stiffness")] = 0.35
    integral_max_m_s2: Annotated[float, span(0.0, 9.0, "m/s^2", "of the position loop's integral: a steady wind")] = 3.0
    torque_integral_per_s: Annotated[
        float, span(0.0, 10.0, "1/s", "of the attitude loop's stiffness: about that of the autopilots' rate loops")
    ] = 1.5
    torque_integral_max_rad_s2: Annotated[float, span(0.0, 200.0, "rad/s^2", "of the attitude loop's integral")] = 25.0
    lead_share: Annotated[float, span(0.0, 1.0, "", "of the motors' lag, given back by the derivative of the gyro")] = (
        0.9
    )
    lead_s: Annotated[float, span(0.001, 0.1, "s", "smoothing of that derivative: 30 Hz")] = 0.0053
    turning_s: Annotated[float, span(0.005, 1.0, "s", "smoothing of the rate at which the attitude wanted turns")] = (
        0.04
    )
    turning_max_rad_s: Annotated[float, span(0.0, 20.0, "rad/s", "of that rate: more is a jump of the target")] = 2.0
    link_and_filter_s: Annotated[
        float, span(0.005, 0.2, "s", "delays of the loop besides the motors' lag: the gains follow from their sum")
    ] = 0.03
    rate_gain: Annotated[
        float, span(0.2, 1.5, "", "rate gain times the loop's delay: sensitivity at most about 1.75 at 0.9")
    ] = 0.9
    attitude_ratio: Annotated[float, span(1.5, 10.0, "", "rate gain over attitude gain: the outer loop is slower")] = (
        2.4
    )
    velocity_ratio: Annotated[float, span(1.5, 10.0, "", "attitude gain over velocity gain")] = 2.5
    position_ratio: Annotated[float, span(1.5, 10.0, "", "velocity gain over position gain")] = 2.5
    yaw_share: Annotated[float, span(0.05, 1.0, "", "of the gains, for yaw: its torque is slower and scarcer")] = 0.5
    rate_max_rad_s: Annotated[float, span(0.5, 20.0, "rad/s", "roll and pitch rate asked for")] = 4.0
    yaw_rate_max_rad_s: Annotated[float, span(0.1, 10.0, "rad/s", "yaw rate asked for")] = 1.0
    min_thrust_share: Annotated[
        float, span(0.02, 0.8, "", "of hover: the vehicle stays controllable while it falls")
    ] = 0.15


class ProbeTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How motors are moved to tell which of them are lost (allocation/probe.py)."""

    thrust_max: Annotated[
        float, span(0.0, 0.2, "", "of its full thrust, by which a motor is moved at most; 0: nothing is tested")
    ] = 0.15
    thrust_left: Annotated[
        float, span(0.0, 0.3, "", "of its full thrust, that each motor keeps below and above: it goes on controlling")
    ] = 0.05
    tilt_max_deg: Annotated[
        float, span(0.1, 5.0, "deg", "by which that turns the vehicle, whichever of the sets is lost")
    ] = 0.7
    part_s: Annotated[
        float, span(0.03, 0.5, "s", "of each of the four parts of a test: longer than the motors' lag and the link's")
    ] = 0.06
    deviations: Annotated[
        float, span(3.0, 50.0, "deviations", "of the residual, between what two sets say: 10 are mistaken once in 3e6")
    ] = 14.0
    deviations_min: Annotated[
        float, span(0.5, 20.0, "deviations", "below which a test would say nothing, and is not made")
    ] = 2.0
    tests_max: Annotated[int, span(1, 100, "tests", "in a row; then the vehicle is left in peace")] = 6
    rest_s: Annotated[float, span(0.5, 600.0, "s", "for as long as this")] = 5.0


class CompanionTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which samples are used, and when the companion may act (admission.py, companion.py)."""

    gap_max_s: Annotated[float, span(0.02, 1.0, "s", "without a sample: the estimate starts anew")] = 0.1
    recover_s: Annotated[float, span(0.0, 10.0, "s", "of good samples, to act again")] = 0.3
    gyro_max_rad_s: Annotated[
        float, span(10.0, 200.0, "rad/s", "beyond what any vehicle survives: a fault of the sensor or the link")
    ] = 60.0
    force_max_m_s2: Annotated[float, span(50.0, 2000.0, "m/s^2", "the same of the specific force")] = 400.0
    time_max_s: Annotated[
        float, span(1e5, 1e12, "s", "of the autopilot's clock, since boot or since 1970: a later time is a fault")
    ] = 1e10
    reordered_s: Annotated[
        float, span(0.0, 1.0, "s", "a sample this much older than the last one came twice or late: ignored, no jump")
    ] = 0.1
    repeated_share: Annotated[
        float, span(0.0, 0.9, "", "of the sample time: a sample that follows sooner came twice or late as well")
    ] = 0.2
