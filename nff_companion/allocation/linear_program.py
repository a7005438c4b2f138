"""A small linear program, solved by HiGHS, then made unique.

Vertices of a linear program are not unique: a small change of the effectiveness could make the matrix jump. Among
the optimal points the one nearest to a reference (the pseudo-inverse's trim and columns) is taken, by a strictly
convex quadratic program on the optimal face.
"""

from __future__ import annotations

from dataclasses import dataclass

import daqp
import highspy
import numpy as np
from numpy.typing import NDArray

from nff_companion.errors import AllocationInfeasible, SolverError

_INFINITE = 1e20


@dataclass(frozen=True, kw_only=True)
class Program:
    """max objective . x  with  lower <= rows x <= upper  and  column_lower <= x <= column_upper."""

    objective: NDArray[np.float64]
    rows: NDArray[np.float64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    column_lower: NDArray[np.float64]
    column_upper: NDArray[np.float64]


class LinearSolver:
    """Keeps one HiGHS instance; a program of the same shape starts from the last basis."""

    def __init__(self) -> None:
        self._highs = highspy.Highs()
        self._highs.setOptionValue("output_flag", False)
        self._highs.setOptionValue("threads", 1)
        self._highs.setOptionValue("presolve", "off")
        self._shape: tuple[int, int] | None = None

    def solve(self, program: Program) -> NDArray[np.float64]:
        """Optimal x. Raises AllocationInfeasible when there is none, SolverError when the solver gives up."""
        count, width = program.rows.shape
        basis = self._highs.getBasis() if self._shape == (count, width) else None
        self._highs.passModel(_model(program))
        if basis is not None and basis.valid:
            self._highs.setBasis(basis)
        self._shape = (count, width)
        self._highs.run()
        status = self._highs.getModelStatus()
        if status == highspy.HighsModelStatus.kOptimal:
            return np.array(self._highs.getSolution().col_value)
        self._shape = None
        if status in (highspy.HighsModelStatus.kInfeasible, highspy.HighsModelStatus.kUnboundedOrInfeasible):
            raise AllocationInfeasible(
                "the motors left cannot balance weight and torques at hover: give up yaw, or land"
            )
        raise SolverError(f"linear program: HiGHS ended with {status}; the last good matrix stays in force")


def _model(program: Program) -> highspy.HighsLp:
    count, width = program.rows.shape
    row, column = np.nonzero(program.rows)
    lp = highspy.HighsLp()
    lp.num_col_, lp.num_row_ = width, count
    lp.sense_ = highspy.ObjSense.kMaximize
    lp.col_cost_ = program.objective
    lp.col_lower_, lp.col_upper_ = program.column_lower, program.column_upper
    lp.row_lower_, lp.row_upper_ = program.lower, program.upper
    lp.a_matrix_.format_ = highspy.MatrixFormat.kRowwise
    lp.a_matrix_.start_ = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=count))])
    lp.a_matrix_.index_ = column
    lp.a_matrix_.value_ = program.rows[row, column]
    return lp


def nearest_optimal(
    program: Program, optimum: NDArray[np.float64], reference: NDArray[np.float64], slack: float = 1e-6
) -> NDArray[np.float64]:
    """The point of the optimal face nearest to ``reference`` (NaN: no preference). Raises SolverError."""
    rows = np.vstack([program.rows, program.objective])
    value = float(program.objective @ optimum)
    lower = np.concatenate([program.column_lower, program.lower, [value - slack]])
    upper = np.concatenate([program.column_upper, program.upper, [_INFINITE]])
    lower, upper = np.clip(lower, -_INFINITE, _INFINITE), np.clip(upper, -_INFINITE, _INFINITE)
    sense = np.where(lower == upper, 5, 0).astype(np.int32)
    preferred = np.isfinite(reference)
    weight = np.where(preferred, 1.0, 1e-4)
    pull = -np.where(preferred, reference, optimum) * weight
    x, _, flag, _ = daqp.solve(np.diag(weight), pull, np.ascontiguousarray(rows), upper, lower, sense)
    if flag != 1:
        raise SolverError(f"tie break: the quadratic program ended with flag {flag}; the last good matrix stays")
    return np.asarray(x)
