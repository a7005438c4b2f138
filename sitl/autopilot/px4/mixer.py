"""One vehicle's allocation as its parameters describe it: looked at while it flies, but at most once a second."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sitl.airframe import PlantParameters
from sitl.autopilot.mixer import Mixed, stock_factors
from sitl.autopilot.px4.allocation import (
    PITCH,
    ROLL,
    THRUST_Z,
    YAW,
    Allocation,
    Rotors,
    allocation,
    effectiveness,
    thrusts,
)
from sitl.autopilot.px4.outputs import Outputs
from sitl.autopilot.px4.parameters import ParameterTable

_LOOK_S = 1.0  # the allocator's subscription to changed parameters
_UNMET = 0.01  # of a demand: less is the rounding of small gains
_TORQUES = (ROLL, PITCH, YAW)


class Px4Mixer:
    """Motors in arrays count from 0. ``stopped`` by injection; ``removed`` from the allocation: the first of them."""

    def __init__(self, table: ParameterTable, nominal: PlantParameters) -> None:
        self._table, self._nominal = table, nominal
        motors = nominal.motors
        self.stopped = np.zeros(motors, bool)
        self.removed = np.zeros(motors, bool)
        self._armed = False
        self._seen, self._looked_s = table.changes, -np.inf
        self._outputs = Outputs.read(table, motors)
        self._rotors = self._read_rotors()
        self._airmode, self._desaturate = self._read_method()
        self.allocation: Allocation = allocation(self._rotors)
        self.pulses_us = self._outputs.disarmed_us  # (m,) of the last cycle
        # The loops are tuned for factors of theirs, and for a healthy vehicle: so much demand is one unit of theirs.
        own = stock_factors(nominal.frame_m, nominal.spin)
        healthy = Rotors(
            position_m=np.pad(nominal.frame_m / np.hypot(*nominal.frame_m.T).max(), ((0, 0), (0, 1))),
            axis=np.tile([0.0, 0.0, -1.0], (motors, 1)),
            thrust=np.ones(motors),
            moment=nominal.spin,
        )
        effect, mix = effectiveness(healthy), allocation(healthy).mix
        self._unit = np.array([(effect[k] @ own[:, 1 + k]) / (effect[k] @ mix[:, k]) for k in _TORQUES])

    # -- parameters ---------------------------------------------------------------------------------------------

    def _read_rotors(self) -> Rotors:
        """CA_ROTORn_* of as many rotors as CA_ROTOR_COUNT says, at most those that have an output."""
        count = max(0, min(self._table.whole("CA_ROTOR_COUNT"), self._nominal.motors))

        def columns(*suffixes: str) -> NDArray[np.float64]:
            read = [[self._table[f"CA_ROTOR{i}_{s}"] for s in suffixes] for i in range(self._nominal.motors)]
            read[count:] = [[0.0] * len(suffixes)] * (self._nominal.motors - count)
            return np.array(read)

        return Rotors(
            position_m=columns("PX", "PY", "PZ"),
            axis=columns("AX", "AY", "AZ"),
            thrust=columns("CT")[:, 0],
            moment=columns("KM")[:, 0],
        )

    def _read_method(self) -> tuple[int, bool]:
        return self._table.whole("MC_AIRMODE"), self._table.whole("CA_METHOD") != 0

    def _look(self, armed: bool, now_s: float) -> None:
        landed, self._armed = self._armed and not armed, armed
        changed = self._table.changes != self._seen and now_s >= self._looked_s + _LOOK_S
        if not changed and not landed:
            return
        self._seen, self._looked_s = self._table.changes, now_s
        outputs = Outputs.read(self._table, self._nominal.motors)
        self._outputs = outputs.wired_as(self._outputs) if armed else outputs
        self._airmode, self._desaturate = self._read_method()
        if not self.removed.any():  # else the geometry stays as it was when the failure was handled
            self._rotors = self._read_rotors()
            self.allocation = allocation(self._rotors)

    def inject(self, stopped: NDArray[np.bool_]) -> None:
        """Motors (m,) that an injected failure stops; the first of them alone is removed, where that is asked for."""
        self.stopped = stopped.copy()
        handles = self._table.whole("CA_FAILURE_MODE") == 1 and self._table.whole("FD_ACT_EN") == 1
        removed = self.removed
        if not stopped.any():
            removed = np.zeros_like(stopped)
        elif handles and not removed.any() and stopped.sum() == 1:
            removed = stopped.copy()
        if (removed != self.removed).any():
            self.removed = removed
            self.allocation = allocation(self._rotors.without(removed), self.allocation.scale)

    # -- one cycle ----------------------------------------------------------------------------------------------

    def mix(self, throttle: float, torque: NDArray[np.float64], *, armed: bool, now_s: float) -> Mixed:
        """``throttle`` 0..1 and ``torque`` (3,) -1..1 as the loops ask for them."""
        self._look(armed, now_s)
        demand = np.zeros(6)
        demand[list(_TORQUES)] = torque * self._unit
        demand[THRUST_Z] = -throttle
        found = self.allocation
        thrust = thrusts(found, demand, airmode=self._airmode, desaturate=self._desaturate)
        unmet = np.abs(demand - found.given(thrust)) > _UNMET
        stopped = self.stopped | self.removed if armed else np.ones_like(self.stopped)
        self.pulses_us = self._outputs.pulses_us(thrust, stopped)
        p = self._nominal
        return Mixed(
            output=np.clip((self.pulses_us - p.pwm_min) / (p.pwm_max - p.pwm_min), 0.0, 1.0),
            torque_limited=unmet[list(_TORQUES)],
            throttle_limited=bool(unmet[THRUST_Z]),
        )
