"""Numbers by which a motor is found to give less than it did earlier in the flight (core/wear.py).

Measured: octo-x, octo-plus, coax-x8, 4 m/s with gusts of 1 m/s, files as a calibration leaves them.
"""

from __future__ import annotations

from typing import Annotated

import msgspec

from nff_companion.core.tuning.span import PerAxis, about, span


class WearTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When a motor is said to give less than it gave before (core/wear.py). Deviations of what was never seen are of
    what the loss of one motor does to an axis, in the order lift, roll, pitch, yaw."""

    block_s: Annotated[
        float, span(0.2, 10.0, "s", "whose means are looked at: gusts and the gyro's noise average out")
    ] = 1.0
    recent: Annotated[
        int, span(2, 60, "blocks", "that are compared with those before, and are learnt when they are older")
    ] = 8
    independent_blocks: Annotated[
        float, span(1.0, 60.0, "blocks", "that so many together count for at most: gusts last longer than one")
    ] = 3.0
    hold_blocks: Annotated[
        int,
        span(
            0,
            600,
            "blocks",
            "for which nothing is learnt while some motor may give less, or what may be a load is said",
        ),
    ] = 30
    side_max_m_s2: Annotated[
        float, span(0.5, 20.0, "m/s^2", "of side force, as in some 8 m/s of wind: faster flight is not looked at")
    ] = 2.0
    known_blocks: Annotated[int, span(1, 600, "blocks", "of earlier flight, for a comparison")] = 4
    memory_blocks: Annotated[
        float,
        span(10.0, 3600.0, "blocks", "over which the scatter is learnt, and in which what was learnt may move by it"),
    ] = 60.0
    scatter: Annotated[PerAxis, about("of a lost motor", "standard deviation of a block, before any was seen")] = (
        0.1,
        0.01,
        0.01,
        0.02,
    )
    scatter_min: Annotated[float, span(0.01, 1.0, "of scatter", "below it no flight is taken to be")] = 0.2
    spread_limit: Annotated[
        float, span(1.0, 10.0, "deviations", "of one block, beyond which it counts no more: a gust is not the usual")
    ] = 3.0
    scatter_blocks: Annotated[float, span(1.0, 100.0, "blocks", "that this counts for")] = 5.0
    steady_deviation: Annotated[
        float, span(0.1, 10.0, "of a lost motor", "that lift, centre of mass and torque of the file may be off")
    ] = 2.0
    side_deviation: Annotated[
        float, span(0.01, 10.0, "of a lost motor", "for each m/s^2 of side wind, which turns the vehicle by its rotors")
    ] = 0.2
    rate_deviation: Annotated[
        float, span(0.01, 10.0, "of a lost motor", "for each rad/s about the yaw axis, which the air brakes")
    ] = 0.3
    model_error: Annotated[
        PerAxis, about("", "share of what a motor's loss does to an axis that the file may have wrong")
    ] = (0.3, 0.15, 0.15, 0.4)
    rotor_share: Annotated[
        float, span(0.0, 1.0, "", "of the side force that acts at the rotors: between none and all of it")
    ] = 0.5
    load_error: Annotated[
        float, span(0.01, 1.0, "", "share of what side force turns beside a load that was moved: inertias may be off")
    ] = 0.15
    loss_min: Annotated[float, span(0.01, 0.5, "", "least loss that is said")] = 0.06
    loss_ends: Annotated[float, span(0.01, 0.5, "", "a loss below it by one deviation is no longer said")] = 0.04
    deviation_max: Annotated[float, span(0.005, 0.5, "", "standard deviation of a loss that is said")] = 0.03
    improvement_min: Annotated[float, span(3.0, 200.0, "nats", "over that no motor gives less than before")] = 12.0
    margin_min: Annotated[float, span(1.0, 100.0, "nats", "over another motor, and over that the air turns it")] = 6.0
    load_margin_min: Annotated[
        float,
        span(0.0, 100.0, "nats", "over a load that was moved: that it turns the yaw of a motor is a chance of few"),
    ] = 3.0
    load_behind_max: Annotated[
        float, span(0.0, 100.0, "nats", "behind a load that was moved, where it is said that it is one of the two")
    ] = 5.0
    alike: Annotated[int, span(1, 20, "blocks", "in a row that say the same motor, to be believed")] = 3
