"""Numbers by which a flight confirms its airframe file, or contradicts it (core/fit_monitor.py).

Measured means: on flights of octo-x, hexa-x, octo-plus and coax-x8, as their files are and as far off as an estimated
file is, winds of 0 to 8 m/s, steps and turns after 3 s (docs/fit.md).
"""

from __future__ import annotations

from typing import Annotated

import msgspec

from nff_companion.core.tuning.span import span


class FitTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When a flight says that the airframe file fits the vehicle (core/fit_monitor.py)."""

    look_hz: Annotated[float, span(10.0, 200.0, "Hz", "samples that are looked at: the motion has no more to tell")] = (
        50.0
    )
    slow_hz: Annotated[float, span(0.05, 5.0, "Hz", "below it the air moves the vehicle, and steady errors")] = 0.7
    fast_hz: Annotated[float, span(2.0, 50.0, "Hz", "above it the gyro's noise is larger than the motion")] = 6.0
    settle_s: Annotated[float, span(0.1, 10.0, "s", "after a start, until the filters have forgotten it")] = 0.5
    memory_s: Annotated[float, span(5.0, 600.0, "s", "time constant of forgetting")] = 20.0
    judge_s: Annotated[float, span(0.1, 10.0, "s", "between two judgements")] = 1.0
    alike: Annotated[int, span(1, 20, "judgements", "in a row, to be believed")] = 2
    settled_s: Annotated[float, span(0.5, 60.0, "s", "of flight, for factors: climbs and gusts average out")] = 3.0
    independent_hz: Annotated[
        float, span(0.5, 50.0, "Hz", "independent looks at the motion: of the bandwidth, and the file's own misfit")
    ] = 8.0
    mixer_error: Annotated[
        float, span(0.01, 1.0, "", "of a motor's share: firmwares round, and frames are not quite regular")
    ] = 0.15
    word_s: Annotated[
        float, span(3.0, 60.0, "s", "of flight after which the pilot hears why the file is neither confirmed nor wrong")
    ] = 9.0
    order_margin: Annotated[
        float, span(5.0, 500.0, "", "chi squared by which one order must be likelier: measured 30 to 130 after a turn")
    ] = 20.0
    nose_margin: Annotated[
        float,
        span(
            5.0, 500.0, "", "the same for a nose elsewhere: 2 s after a motor was lost it looked likelier by up to 27"
        ),
    ] = 45.0
    misfit_max: Annotated[
        float, span(20.0, 5000.0, "", "chi squared of an order that fits: measured at most 83, and 50 after 10 s")
    ] = 120.0
    misfit_wrong: Annotated[
        float, span(50.0, 5000.0, "", "chi squared of an order that does not, though no other is known to fit better")
    ] = 250.0
    answers_memory_s: Annotated[
        float, span(2.0, 120.0, "s", "time constant of forgetting how the motors answer: a failure must show in it")
    ] = 8.0
    answers_lost_min: Annotated[
        float,
        span(
            0.3,
            0.95,
            "",
            "of a motor's changes that do not come, for it not to answer: by a guessed file 0.72 in leaps of 20 m",
        ),
    ] = 0.75
    answers_balance: Annotated[
        float, span(0.001, 0.5, "of the arm", "standard deviation of where the centre of mass is by the file")
    ] = 0.05
    answers_hysteresis: Annotated[float, span(0.0, 0.5, "", "less of them, by which it goes on being believed")] = 0.25
    answers_improvement_min: Annotated[
        float, span(5.0, 200.0, "nats", "over that all motors answer: 264 healthy flights by guessed files came to 16")
    ] = 24.0
    answers_margin_min: Annotated[float, span(2.0, 100.0, "nats", "over that another motor does not answer")] = 6.0
    answers_alike: Annotated[int, span(1, 20, "judgements", "in a row of the same motor, to be believed")] = 3
    ridge: Annotated[
        float, span(1e-12, 1e-3, "", "of the energies, added where sums are inverted: signals may go together")
    ] = 1e-6
    explained_min: Annotated[
        float, span(0.1, 0.99, "", "share of an axis' motion that the commands explain, for its gain to be known")
    ] = 0.6
    gain_deviation: Annotated[
        float,
        span(0.001, 2.0, "", "of the logarithm of what a file makes of roll and pitch, beside what it makes of lift"),
    ] = 0.15
    gain_noise: Annotated[float, span(0.001, 1.0, "", "of the logarithm of a factor seen, whose ends agree")] = 0.06
    gain_deviations_max: Annotated[
        float, span(0.5, 10.0, "deviations", "of each, at most: what is beyond is not the file's error")
    ] = 2.0
    said_thrust: Annotated[
        float, span(1.02, 2.0, "", "factor of thrust over weight, either way, that is worth saying")
    ] = 1.1
    said_turn: Annotated[
        float, span(1.02, 3.0, "", "factor of an angular acceleration, either way, that is worth saying")
    ] = 1.2
    fits: Annotated[
        float,
        span(1.05, 3.0, "", "factor up to which a file fits: with yaw 1.54 times its, healthy motors were declared"),
    ] = 1.3
    wrong_thrust: Annotated[
        float, span(1.1, 5.0, "", "factor that is none of this vehicle: an estimated file is up to 1.45 off")
    ] = 1.65
    wrong_turn: Annotated[float, span(1.1, 10.0, "", "the same of an angular acceleration")] = 2.5
    early_s: Annotated[
        float, span(-0.1, 0.1, "s", "by which motors seem quicker where the file is right: how outputs are sampled")
    ] = 0.003
    lag_explained: Annotated[
        float, span(0.1, 0.999, "", "share that roll or pitch must be explained by, for the lag: a gust looks like one")
    ] = 0.9
    said_lag_s: Annotated[
        float,
        span(
            0.001,
            0.2,
            "s",
            "of the motors' response: said, and a file off by more does not fit: with 8 ms healthy ones were declared",
        ),
    ] = 0.006
    partial_lag_s: Annotated[
        float,
        span(0.001, 0.2, "s", "of the same, beyond which a turn looks like a partial loss, and none is acted upon"),
    ] = 0.004
