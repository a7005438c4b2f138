"""Seven flights whose outputs are kept: what the companion was given, and what it made of it.

``python tests/golden/flights.py`` flies them (closed loop, the emulated vehicle) and writes ``*.npz`` beside this file;
``tests/unit/test_golden.py`` gives the recorded samples to the companion again. Inputs are kept in 32 bits, as
telemetry carries them, so that a replay sees the very numbers of the recording.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import platform
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nff_companion.companion import Companion
from nff_companion.companion_state import Orders, Output
from nff_companion.condition import Condition, Mode, Reason, Statement
from nff_companion.core import basis_network
from nff_companion.core import vehicle as vehicle_model
from nff_companion.core.sample import Sample
from sitl import airframe as plant_airframe
from sitl.faults import Fault
from sitl.fleet import AUTOPILOT_RATE_HZ, Fleet, FleetOptions
from sitl.trials import forward

FOLDER = Path(__file__).parent
KEEP_EVERY = 10  # of the steps, in full; of all of them the digest
VECTORS = (
    "gyro_rad_s",
    "specific_force_m_s2",
    "output",
    "quaternion",
    "position_m",
    "velocity_m_s",
    "target_position_m",
    "target_velocity_m_s",
    "target_acceleration_m_s2",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Flight:
    """How one of them is flown and replayed."""

    airframe: str = "octo-x"
    seconds: float = 5.0
    faults: tuple[tuple[int, float], ...] = ()
    mode: str = "allocate"
    wind_m_s: float = 4.0
    forward: bool = False
    flown_hz: float = 200.0
    replayed_hz: float = 200.0  # samples in between are interpolated
    restart_at_s: float = 0.0  # above 0: the companion is started in flight, and told what the autopilot holds
    silence_s: tuple[float, float] = (0.0, 0.0)  # telemetry that did not come
    seed: int = 11


FLIGHTS: dict[str, Flight] = {
    "hover": Flight(),
    "single": Flight(faults=((3, 2.5),)),
    "pair": Flight(faults=((1, 2.5), (3, 2.5))),
    "forward": Flight(forward=True, seconds=12.0, faults=((6, 10.0),), wind_m_s=5.0),
    "override": Flight(mode="override", faults=((2, 3.0),), seconds=6.0),
    "px4_rate": Flight(flown_hz=400.0, replayed_hz=250.0, faults=((5, 2.5),)),
    "restart": Flight(faults=((4, 1.5),), restart_at_s=3.0, seconds=8.0, silence_s=(5.0, 5.6)),
}


def machine() -> str:
    """What decides the last bits of a result."""
    return f"{platform.machine()} python {platform.python_version()} numpy {np.__version__}"


def record(flight: Flight) -> list[Sample]:
    """The samples of a closed-loop flight, in 32 bits."""
    samples: list[Sample] = []

    def alter(sample: Sample) -> Sample:
        changes: dict[str, Any] = {name: _rounded(getattr(sample, name)) for name in VECTORS}
        changes["target_yaw_rad"] = None if sample.target_yaw_rad is None else float(np.float32(sample.target_yaw_rad))
        samples.append(dataclasses.replace(sample, **changes))
        return samples[-1]

    fleet = Fleet(
        plant_airframe.load(vehicle_model.path_of(flight.airframe)),
        FleetOptions(
            seeds=[flight.seed],
            height_m=forward.HEIGHT_M if flight.forward else 10.0,
            wind_m_s=flight.wind_m_s,
            turbulence_m_s=0.25 * flight.wind_m_s,
            model_error=0.05,
        ),
        [Fault(vehicle=0, motor=motor, start_s=at) for motor, at in flight.faults],
    )
    from sitl.trials.virtual import TrialOptions, VirtualFlight

    trial = VirtualFlight(
        fleet,
        {0: TrialOptions(mode=Mode[flight.mode.upper()])},
        airframe=flight.airframe,
        thrust_to_weight=None,
        rate_hz=flight.flown_hz,
        link_delay_s=0.01,
        alter=alter,
    )
    script = forward.Script(fleet, [flight.seed], forward.SPEEDS_M_S, from_s=1.0) if flight.forward else None
    for _ in range(int(AUTOPILOT_RATE_HZ * flight.seconds)):
        if script is not None:
            script.step(fleet.time_s)
        trial.step()
    return samples


def _rounded(value: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    return None if value is None else np.asarray(value, np.float32).astype(float)


def pack(flight: Flight, samples: list[Sample]) -> dict[str, NDArray[np.float64]]:
    """Arrays of the samples that the replay is to see."""
    time_s = np.array([s.time_s for s in samples])
    columns = {name: np.array([getattr(s, name) for s in samples]) for name in VECTORS}
    columns["target_yaw_rad"] = np.array([s.target_yaw_rad for s in samples])
    if flight.replayed_hz != flight.flown_hz:
        grid = np.arange(time_s[0], time_s[-1], 1.0 / flight.replayed_hz)
        columns = {name: _interpolated(grid, time_s, value) for name, value in columns.items()}
        time_s = grid
    silent = (time_s > flight.silence_s[0]) & (time_s < flight.silence_s[1])
    keep = (time_s >= flight.restart_at_s) & ~silent
    return {"time_s": time_s[keep], **{name: value[keep].astype(np.float32) for name, value in columns.items()}}


def _interpolated(
    grid: NDArray[np.float64], time_s: NDArray[np.float64], value: NDArray[np.float64]
) -> NDArray[np.float64]:
    flat = value.reshape(len(value), -1)
    out = np.column_stack([np.interp(grid, time_s, column) for column in flat.T])
    return out.reshape(len(grid), *value.shape[1:])


def unpack(inputs: dict[str, NDArray[np.float64]]) -> list[Sample]:
    """The samples again."""
    rows = {name: inputs[name].astype(float) for name in (*VECTORS, "target_yaw_rad")}
    return [
        Sample(
            time_s=float(inputs["time_s"][k]),
            armed=True,
            target_yaw_rad=float(rows["target_yaw_rad"][k]),
            **{name: rows[name][k] for name in VECTORS},
        )
        for k in range(len(inputs["time_s"]))
    ]


def replay(flight: Flight, samples: list[Sample]) -> tuple[list[NDArray[np.float64]], list[list[float]]]:
    """One row of outputs a sample, and the events (time, motor, declared, effectiveness, confidence)."""
    model = vehicle_model.load(flight.airframe)
    companion = Companion(model, flight.replayed_hz, network=basis_network.for_vehicle(model, "airframe"))
    state, condition = companion.start(Mode[flight.mode.upper()]), Condition(takes_matrix=True)
    if flight.restart_at_s:
        state, _ = companion.step(state, None, condition, Orders(adopt=tuple(motor for motor, _ in flight.faults)))
    rows: list[NDArray[np.float64]] = []
    events: list[list[float]] = []
    before = None
    for sample in samples:
        if before is not None and sample.time_s - before > 0.25:
            stopped = Statement(Reason.TELEMETRY_STOPPED, "0.25")
            state, _ = companion.interrupted(state, condition, stopped)
        before = sample.time_s
        state, answer = companion.respond(state, sample, condition)
        state, output = companion.step(state, sample, condition, override=answer)
        rows.append(row_of(output, model.motors, model.axes))
        events += [[e.time_s, e.motor, e.declared, e.effectiveness, e.confidence] for e in output.events]
    return rows, events


def row_of(output: Output, motors: int, axes: int) -> NDArray[np.float64]:
    """Everything that matters of one output; NaN: there was none."""
    estimate = output.estimate
    nothing = np.full(axes, np.nan)
    return np.concatenate(
        [
            [output.time_s, int(output.mode), output.flying],
            output.failed.astype(float),
            output.degraded.astype(float),
            output.effectiveness,
            output.deviation,
            nothing if estimate is None else estimate.residual,
            nothing if estimate is None else estimate.disturbance,
            output.unallocated,
            np.full(motors, np.nan) if output.override is None else output.override,
            np.full(motors * axes, np.nan) if output.plan is None else output.plan.matrix.ravel(),
        ]
    )


def digest(rows: list[NDArray[np.float64]]) -> str:
    """Of every bit of every row."""
    return hashlib.sha256(np.array(rows).tobytes()).hexdigest()


def load(name: str) -> tuple[dict[str, NDArray[np.float64]], NDArray[np.float64], dict[str, Any]]:
    """Inputs, kept rows, and what else was noted."""
    with np.load(FOLDER / f"{name}.npz", allow_pickle=False) as file:
        arrays = {key: file[key] for key in file.files}
    noted = json.loads(str(arrays.pop("noted")))
    return arrays, arrays.pop("rows"), noted


def write(name: str, inputs: dict[str, NDArray[np.float64]]) -> None:
    """Replay ``inputs`` and keep what comes out."""
    rows, events = replay(FLIGHTS[name], unpack(inputs))
    noted = json.dumps({"machine": machine(), "digest": digest(rows), "events": events})
    np.savez_compressed(
        FOLDER / f"{name}.npz", allow_pickle=False, rows=np.array(rows[::KEEP_EVERY]), noted=np.array(noted), **inputs
    )
    print(name, len(rows), "steps", events)


def main() -> None:
    """Fly them anew; with ``--outputs`` the samples stay and only what is made of them is written again."""
    import sys

    for name, flight in FLIGHTS.items():
        write(name, load(name)[0] if "--outputs" in sys.argv else pack(flight, record(flight)))


if __name__ == "__main__":
    main()
