"""Are motors where the file has them, and do they turn as it says? The log's own mixer answers.

A mixer gives each motor shares of the torques that it wants, and what it wants it gets where the vehicle flies well:
each motor's thrust follows the measured accelerations with just the shares that the autopilot gives it. From them
every motor's place and spin is read, as the autopilot believes it to be; then every order of the file's motors is
compared with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nff_companion.calibration import chain, model
from nff_companion.calibration.model import Layout
from nff_companion.calibration.record import Record
from nff_companion.core.motor_order import Order, orders

# Where the vehicle's own motion is above the air's: roll and pitch; yaw, of which the air and the gyro have the rest.
_BANDS_HZ = ((0.7, 6.0), (0.3, 2.0))
_SETTLE_S = 0.5
_AXES = (model.ROLL, model.PITCH, model.YAW)
# A flight that turns: at this rate, and its yaw motion goes with the outputs, freely (0.42 to 0.6 of flights that never
# turned, in which the outputs answer the air; 0.65 to 0.75 of others) and by the spins of one of the orders (0.02 to
# 0.12; 0.54 and more).
_TURN_RAD_S, _TURNED, _TURNED_ALIKE = 0.25, 0.58, 0.35
_SAME = 1e-9  # orders that differ in nothing that was seen


@dataclass(frozen=True, slots=True)
class Weighed:
    """The order that fits best; ``off`` of it, of the file's own and of the next best one: mean square of the shares'
    difference, over that of the shares (0: the same, 2: nothing in common)."""

    best: Order
    off: float
    off_file: float
    off_next: float


def considered(layout: Layout) -> list[Order]:
    """The file's own first; then every two motors swapped, every spin reversed, and all. A turned nose is none of them:
    gusts and spin make roll and pitch look turned by up to some twenty degrees."""
    return [each for each in orders(layout.rows[list(_AXES)]) if not each.turned_deg]


@dataclass(frozen=True, slots=True)
class Shares:
    """``rows`` (3, m) of roll, pitch and yaw that each motor is given; ``weight`` (3, m, m) of the motors' differences:
    less where the outputs do what goes with no acceleration; ``turned``: yaw tells."""

    rows: NDArray[np.float64]
    weight: NDArray[np.float64]
    turned: bool


def shares(
    record: Record,
    layout: Layout,
    filters: chain.Filters,
    motors: chain.Motors,
    inertia: tuple[float, float, float],
) -> Shares:
    """Of a record; ``layout`` in one order or another."""
    m = record.pieces[0].output.shape[1]
    sums = np.zeros((len(_BANDS_HZ), 3 + m, 3 + m))
    for piece in record.pieces:
        skip = round(_SETTLE_S / piece.dt_s)
        measured = chain.measured(piece, filters, inertia)[:, list(_AXES)]
        both = np.column_stack([measured, chain.shown(piece, [motors], filters)[0]])
        for k, band_hz in enumerate(_BANDS_HZ):
            kept = np.column_stack([chain.band(column, piece.dt_s, *band_hz) for column in both.T])[skip:-skip]
            sums[k] += kept.T @ kept
    (fast, fast_weight), (slow, slow_weight) = (_given(total) for total in sums)
    rows, weight = np.stack([fast[0], fast[1], slow[2]]), np.stack([fast_weight, fast_weight, slow_weight])
    yaw = sums[1]
    by_motors, cross = yaw[3:, 3:], yaw[3:, 2]
    power = max(float(yaw[2, 2]), 1e-30)
    told = float(cross @ np.linalg.lstsq(by_motors, cross, rcond=1e-6)[0]) / power
    spins = np.array([each.rows[-1] for each in considered(layout)])
    along = np.maximum(spins @ cross, 0.0) ** 2 / np.einsum("om,mk,ok->o", spins, by_motors, spins) / power
    rate = np.concatenate([np.abs(piece.gyro_rad_s[:, 2]) for piece in record.pieces])
    turns = float(np.percentile(rate, 98.0)) >= _TURN_RAD_S
    return Shares(rows, weight, turns and told >= _TURNED and float(along.max()) >= _TURNED_ALIKE)


def _given(total: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Shares (3, m) of the motors in the sums (3 + m, 3 + m) of accelerations and thrusts, and the weight (m, m) of
    their errors: what the mixer does beside, yaw that the gyro does not show, is one pattern of the motors, by chance
    alike to roll and pitch."""
    shares = np.asarray(np.linalg.lstsq(total[:3, :3], total[:3, 3:], rcond=1e-12)[0])
    beside = total[3:, 3:] - total[3:, :3] @ shares
    mean = max(float(np.trace(beside)) / len(beside), 1e-30)
    return shares, np.asarray(np.linalg.inv(np.eye(len(beside)) + 0.5 * (beside + beside.T) / mean))


def weigh(found: Shares, layout: Layout) -> Weighed:
    """Which order of ``layout`` has the shares ``found``; spins alone are not judged of a flight that never turned."""
    all_orders = [each for each in considered(layout) if found.turned or not each.reversed]
    off = np.array([_off(found, each.rows) for each in all_orders])
    ranked = np.argsort(off, kind="stable")
    best = int(ranked[0])
    if off[best] >= off[0] - _SAME:
        best = 0
    following = float(min(off[k] for k in range(len(off)) if k != best))
    return Weighed(all_orders[best], float(off[best]), float(off[0]), following)


def _off(found: Shares, rows: NDArray[np.float64]) -> float:
    axes = slice(None) if found.turned else slice(2)
    weight = found.weight[axes]
    apart = _scaled(found.rows[axes], weight) - _scaled(rows[axes], weight)
    return float(np.mean(np.einsum("am,amn,an->a", apart, weight, apart)))


def _scaled(rows: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """``rows`` (axes, m) of weighted square 1."""
    return np.asarray(rows / np.sqrt(np.einsum("am,amn,an->a", rows, weight, rows))[:, None])
