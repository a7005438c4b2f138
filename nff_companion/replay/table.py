"""Samples of a log as columns: a row is made where it is asked for, and of most there is no need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import overload

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.sample import Sample
from nff_companion.replay.flight import Row

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Table(Sequence[Row]):
    """Columns (N,) or (N, c) of what ``Sample`` has; None: not in the log. ``stamp_s`` (N,) times of arrival."""

    stamp_s: Array
    time_s: Array
    gyro_rad_s: Array
    specific_force_m_s2: Array
    output: Array
    armed: NDArray[np.bool_]
    quaternion: Array | None = None
    position_m: Array | None = None
    velocity_m_s: Array | None = None
    thrust: Array | None = None
    rotor_speed_rad_s: Array | None = None
    rotor_speed_time_s: Array | None = None

    def __len__(self) -> int:
        return len(self.time_s)

    @overload
    def __getitem__(self, index: int) -> Row: ...
    @overload
    def __getitem__(self, index: slice) -> Table: ...
    def __getitem__(self, index: int | slice) -> Row | Table:
        if isinstance(index, slice):
            return self.taken(np.arange(len(self))[index])
        if not -len(self) <= index < len(self):
            raise IndexError(f"row {index} of {len(self)}")
        return self._row(index)

    def taken(self, index: NDArray[np.int64]) -> Table:
        """The rows of ``index`` (K,)."""
        return replace(self, **{name: column[index] for name, column in vars(self).items() if column is not None})

    def _row(self, k: int) -> Row:
        q, x, v, u = self.quaternion, self.position_m, self.velocity_m_s, self.thrust
        speed, read_s = self.rotor_speed_rad_s, self.rotor_speed_time_s
        return float(self.stamp_s[k]), Sample(
            time_s=float(self.time_s[k]),
            gyro_rad_s=self.gyro_rad_s[k],
            specific_force_m_s2=self.specific_force_m_s2[k],
            output=self.output[k],
            armed=bool(self.armed[k]),
            quaternion=None if q is None else q[k],
            position_m=None if x is None else x[k],
            velocity_m_s=None if v is None else v[k],
            thrust=None if u is None else u[k],
            rotor_speed_rad_s=None if speed is None else speed[k],
            rotor_speed_time_s=None if read_s is None else read_s[k],
        )
