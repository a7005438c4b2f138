"""The autopilot's door for a companion: what it honours, how long, and what it refuses.

Every command expires by itself (dead-man on this side). Refusals are counted by reason, never raised: a companion
that sends nonsense must not disturb the loop that flies.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

OVERRIDE_TIMEOUT_MAX_S = 0.1
MATRIX_TIMEOUT_MAX_S = 2.0
STALE_AFTER_S = 0.25  # a command built on a sample older than this is refused
FACTOR_MAX = 20.0
REFUSALS = ("range", "nan", "stale", "replay", "dimension", "disarmed")


@dataclass(slots=True)
class _Held:
    value: NDArray[np.float64]
    sequence: int
    expires_s: float


class CompanionPort:
    """One vehicle's port. Times in s of the autopilot's clock; motors in arrays from index 0."""

    def __init__(self, motors: int) -> None:
        self.motors = motors
        self.refused = dict.fromkeys(REFUSALS, 0)
        self.accepted = 0
        self.failed = np.zeros(motors, bool)
        self.declaration_sequence = self.override_echo = self.matrix_echo = 0
        self._matrix: _Held | None = None
        self._override: _Held | None = None
        self._last_override = self._last_matrix = -1
        self._declared_s = -math.inf

    def _refuse(self, reason: str) -> str:
        self.refused[reason] += 1
        return reason

    def _check(self, held: _Held | None, sequence: int, last: int, sample_s: float, now_s: float) -> str | None:
        if not -0.05 <= now_s - sample_s <= STALE_AFTER_S:
            return self._refuse("stale")
        # With nothing in force any sequence may begin: a companion that was restarted counts from the start.
        if held is not None and now_s <= held.expires_s and not 0 < (sequence - last) % 2**32 < 2**31:
            return self._refuse("replay")
        return None

    def receive_matrix(
        self,
        matrix: NDArray[np.float64],
        *,
        sequence: int,
        sample_s: float,
        timeout_s: float,
        now_s: float,
        wanted_axes: int = 4,
        valid: bool = True,
    ) -> str | None:
        """Take an allocation matrix (m, 4); returns the reason of a refusal, None when taken.

        ``valid`` False releases the matrix held at once.
        """
        refusal = self._check(self._matrix, sequence, self._last_matrix, sample_s, now_s)
        if refusal:
            return refusal
        if not valid:
            self._matrix, self._last_matrix = None, sequence
            return None
        if matrix.shape != (self.motors, wanted_axes):
            return self._refuse("dimension")
        if not np.isfinite(matrix).all():
            return self._refuse("nan")
        if np.abs(matrix).max() > FACTOR_MAX or not 0.0 < timeout_s <= MATRIX_TIMEOUT_MAX_S:
            return self._refuse("range")
        self._matrix = _Held(matrix.copy(), sequence, now_s + timeout_s)
        self._last_matrix = self.matrix_echo = sequence
        self.accepted += 1
        return None

    def receive_override(
        self,
        outputs: NDArray[np.float64],
        *,
        sequence: int,
        sample_s: float,
        timeout_s: float,
        now_s: float,
        armed: bool,
    ) -> str | None:
        """Take motor outputs (m,) in 0..1, NaN: leave that motor to the mixer. Returns the reason of a refusal."""
        refusal = self._check(self._override, sequence, self._last_override, sample_s, now_s)
        if refusal:
            return refusal
        if not armed:
            return self._refuse("disarmed")
        if outputs.shape != (self.motors,):
            return self._refuse("dimension")
        if np.isinf(outputs).any():
            return self._refuse("nan")
        driven = outputs[~np.isnan(outputs)]
        out_of_range = driven.size and (driven.min() < 0.0 or driven.max() > 1.0)
        if out_of_range or not 0.0 < timeout_s <= OVERRIDE_TIMEOUT_MAX_S:
            return self._refuse("range")
        self._override = _Held(outputs.copy(), sequence, now_s + timeout_s)
        self._last_override = self.override_echo = sequence
        self.accepted += 1
        return None

    def receive_declaration(
        self, failed: NDArray[np.bool_], *, sequence: int, sample_s: float, now_s: float, armed: bool
    ) -> str | None:
        """Take the set of motors declared failed, (m,) bool. It stays until declared otherwise or disarmed."""
        if not -0.05 <= now_s - sample_s <= STALE_AFTER_S:
            return self._refuse("stale")
        # What was overtaken is stale after so long: then any sequence may begin, as that of a restarted companion.
        ahead = (sequence - self.declaration_sequence) % 2**32
        if now_s - self._declared_s <= STALE_AFTER_S and not 0 < ahead < 2**31:
            return self._refuse("replay")
        if not armed:
            return self._refuse("disarmed")
        if failed.shape != (self.motors,):
            return self._refuse("dimension")
        if failed.sum() > self.motors // 2:
            return self._refuse("range")
        self.failed = failed.copy()
        self.declaration_sequence, self._declared_s = sequence, now_s
        self.accepted += 1
        return None

    def disarmed(self) -> None:
        """Forget everything: the next flight starts stock."""
        self._matrix = self._override = None
        self.failed = np.zeros(self.motors, bool)
        self.declaration_sequence, self._declared_s = 0, -math.inf

    def matrix_at(self, now_s: float) -> NDArray[np.float64] | None:
        """The matrix in force, or None when none is fresh."""
        if self._matrix is not None and now_s > self._matrix.expires_s:
            self._matrix = None
        return None if self._matrix is None else self._matrix.value

    def override_at(self, now_s: float) -> NDArray[np.float64] | None:
        """The outputs in force, or None when none are fresh."""
        if self._override is not None and now_s > self._override.expires_s:
            self._override = None
        return None if self._override is None else self._override.value

    @property
    def next_expiry_s(self) -> float:
        """When what is in force next changes by itself."""
        held = [h.expires_s for h in (self._matrix, self._override) if h is not None]
        return min(held, default=math.inf)
