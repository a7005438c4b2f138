"""CA_ROTORn_CT and _KM: as they were found, as they are wanted until PX4 confirms it, and what it says they are."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nff_companion.autopilots.px4.remedy import Remedy
from nff_companion.condition import InForce, Source, read_only
from nff_companion.mavlink.codec import Message, dialect
from nff_companion.mavlink.services.parameter_reader import ParameterReader, encode

_RESEND_S = 0.05
_DEAD = 0.05  # a CT below this share of what it was counts as declared dead
_ANSWERS_MAX = 3  # with another value than was sent: it is not taken
_LATE_S = 2.0  # answers to what was sent before may come this late: PX4 takes a burst in parts, up to 1 s apart
_SETTLE_S = 1.0  # what was sent this recently may still be on its way
_REAL = int(dialect.MAV_PARAM_TYPE_REAL32)


def same(value: float, other: float) -> bool:
    """Equal as PX4 stores it, in 32 bits."""
    return abs(value - other) <= 1e-5 * abs(other) + 1e-6


def names_of(motors: int) -> list[str]:
    """Every parameter that may be changed."""
    return [f"CA_ROTOR{i}_{suffix}" for i in range(motors) for suffix in ("CT", "KM")]


@dataclass(slots=True)
class _Wanted:
    value: float
    first_s: float | None = None  # when it was sent first
    others: int = 0  # answers with another value


class ParameterChange:
    """``reader`` knows what PX4 says. Times are of any one monotonic clock, in s."""

    def __init__(self, reader: ParameterReader, target: tuple[int, int], motors: int) -> None:
        self._reader, self._target, self._motors = reader, target, motors
        self.found: Mapping[str, float] = {}  # as they were before us; empty: not known
        self.touched: set[str] = set()  # sent to PX4 with another value, and not yet restored
        self.refused: dict[str, str] = {}  # what PX4 does not take, and how it said so
        self._wanted: dict[str, _Wanted] = {}  # not yet confirmed, in the order to send
        self._before: dict[str, float] | None = None  # confirmed, to go back to; None: there is no way back
        self._restoring = False
        self._said: dict[str, list[float]] = {}  # values sent so far
        self._since_s = self._sent_s = self._changed_s = -np.inf
        self._in_force: InForce | None = None

    # -- what is known ------------------------------------------------------------------------------------------

    def begin(self, found: Mapping[str, float], touched: Iterable[str]) -> None:
        """Take what was found; ``touched``: what an earlier run may have changed."""
        self.found, self.touched, self.refused = found, set(touched), {}
        self._wanted, self._before, self._restoring, self._in_force = {}, None, False, None

    def in_force(self) -> InForce:
        """By PX4's word alone: motors whose CT is gone, yaw given up where every KM is 0."""
        if self._in_force is None:
            self._in_force = self._read_in_force() if self.found else InForce()
        return self._in_force

    def _read_in_force(self) -> InForce:
        moments = [f"CA_ROTOR{i}_KM" for i in range(self._motors)]
        released = all(same(self._reader.values[n], 0.0) for n in moments) and any(self.found[n] for n in moments)
        source = Source.STOCK if self.as_found else Source.DECLARATION  # what others tune is no declaration
        return InForce(source, read_only(np.abs(self.shares()) < _DEAD), released)

    def shares(self) -> NDArray[np.float64]:
        """(m,) CT over what it was, by PX4's word."""
        names = [f"CA_ROTOR{i}_CT" for i in range(self._motors)]
        return np.array([self._reader.values[n] / self.found[n] if self.found[n] else 1.0 for n in names])

    @property
    def as_found(self) -> bool:
        """Whether PX4 says that all we touched is as it was found."""
        return all(same(self._reader.values[name], self.found[name]) for name in self.touched)

    @property
    def pending(self) -> list[str]:
        """What is not yet confirmed."""
        return list(self._wanted)

    def unconfirmed_s(self, now_s: float) -> float:
        """For how long something has been wanted that is not confirmed."""
        return now_s - self._since_s if self._wanted else 0.0

    def restored(self, now_s: float) -> bool:
        """Whether all we touched is as it was found, and nothing can be on its way that changes it again."""
        return not self._wanted and not self.refused and now_s >= self._changed_s + _SETTLE_S and self.as_found

    # -- what is wanted -----------------------------------------------------------------------------------------

    def tell(self, remedy: Remedy, now_s: float) -> None:
        """Want the parameters of this remedy, in the order in which every part of the burst flies best."""
        scale = {
            f"CA_ROTOR{i}_CT": self.found[f"CA_ROTOR{i}_CT"] * float(share)
            for i, share in enumerate(remedy.effectiveness)
        }
        ahead = [] if remedy.first is None else [f"CA_ROTOR{remedy.first}_CT"]
        still = range(self._motors) if remedy.yaw_released else remedy.still
        moment = {f"CA_ROTOR{i}_KM": 0.0 if i in still else self.found[f"CA_ROTOR{i}_KM"] for i in range(self._motors)}
        # Moments that are given up go before the thrusts; those that come back after them: of two that had to get the
        # same command PX4 would make yaw again while one of them is not yet told dead.
        back = [name for name, value in moment.items() if name in self.touched and value != 0.0]
        wanted = {name: scale[name] for name in ahead}
        wanted |= {name: value for name, value in moment.items() if name not in back}
        wanted |= {
            name: scale[name] for name in sorted(scale, key=lambda name: scale[name] != 0.0) if name not in ahead
        }
        wanted |= {name: moment[name] for name in back}
        # What others tune, and we have not touched, is left alone.
        wanted = {n: v for n, v in wanted.items() if n in self.touched or not same(v, self.found[n])}
        self._before = {name: self._reader.values[name] for name in wanted}
        self._restoring = False
        self._want(wanted, now_s)

    def restore(self, now_s: float) -> None:
        """Want back all that was touched: what is on its way may not have been confirmed yet."""
        self._before, self._restoring = None, True
        self._want({name: value for name, value in self.found.items() if name in self.touched}, now_s, every=True)

    def insist(self, now_s: float) -> None:
        """Want back again what was restored, and then turned out to be changed after all."""
        changed = [n for n in self.touched if not same(self._reader.values[n], self.found[n])]
        if any(name not in self._wanted and name not in self.refused for name in changed):
            self.restore(now_s)

    def _want(self, values: Mapping[str, float], now_s: float, *, every: bool = False) -> None:
        on_its_way = {name for name, wanted in self._wanted.items() if wanted.first_s is not None}
        self._wanted = {
            name: _Wanted(value)
            for name, value in values.items()
            if every or name in on_its_way or not same(self._reader.values[name], value)
        }
        self.refused = {}
        self._since_s, self._sent_s = now_s, -np.inf

    def due(self, now_s: float) -> list[Message]:
        """PARAM_SET for everything not yet confirmed, again every 50 ms."""
        if not self._wanted or now_s < self._sent_s + _RESEND_S:
            return []
        self._sent_s = now_s
        return [self._send(name, wanted, now_s) for name, wanted in self._wanted.items()]

    def _send(self, name: str, wanted: _Wanted, now_s: float) -> Message:
        if wanted.first_s is None:
            wanted.first_s = now_s
            self._said.setdefault(name, []).append(wanted.value)
        if not same(wanted.value, self.found[name]):
            self.touched.add(name)
            self._changed_s = now_s
        kind = self._reader.kinds.get(name, _REAL)
        value = encode(wanted.value, kind, bytewise=True)
        return dialect.MAVLink_param_set_message(*self._target, name.encode(), value, kind)

    # -- what PX4 says ------------------------------------------------------------------------------------------

    def heard(self, name: str, now_s: float) -> None:
        """A PARAM_VALUE of ``name`` was read."""
        if name not in self.found:
            return
        self._in_force = None
        value = self._reader.values[name]
        if self._restoring and name in self.refused and same(value, self.found[name]):
            del self.refused[name]  # restored after all
        wanted = self._wanted.get(name)
        if wanted is None or wanted.first_s is None:
            return
        if same(value, wanted.value):
            del self._wanted[name]
            return
        sent_before = any(same(value, v) for v in self._said[name][:-1])
        if sent_before and now_s < wanted.first_s + _LATE_S:
            return
        wanted.others += 1
        if wanted.others >= _ANSWERS_MAX:
            self._give_up(name, f"PX4 keeps {name} at {value:g}", now_s)

    def heard_error(self, name: str, error: int, now_s: float) -> None:
        """PARAM_ERROR for ``name``."""
        wanted = self._wanted.get(name)
        if wanted is None or wanted.first_s is None:
            return
        if same(wanted.value, self._reader.values[name]):
            del self._wanted[name]  # it is as it should be: nothing was taken before either
        else:
            self._give_up(name, f"PX4 refuses {name} (error {error})", now_s)

    def _give_up(self, name: str, why: str, now_s: float) -> None:
        """Half of a declaration flies worse than all of it or none: its other half is taken back."""
        refused = {**self.refused, name: why}
        del self._wanted[name]
        if self._before is not None:
            back = {n: v for n, v in self._before.items() if n != name}
            self._before = None
            self._want(back, now_s)
        self.refused = refused
