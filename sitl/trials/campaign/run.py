"""Batches of a campaign on Dask: workers of this machine, or those of a scheduler anywhere."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from typing import Any

from nff_companion.errors import ConfigError, MissingExtra
from sitl.trials.campaign.fly import fly
from sitl.trials.campaign.scenario import Scenario, batches
from sitl.trials.campaign.store import Store

_CONNECT_S = 10.0
_RETRIES = 2  # of a batch whose worker was lost


def run(
    scenario: Scenario,
    store: Store,
    *,
    scheduler: str = "",
    workers: int = 0,
    progress: Callable[[int, int], None] = lambda done, whole: None,
) -> list[str]:
    """Fly what ``store`` lacks; what went wrong with batches, in words. ``progress`` (flights done, of).

    ``scheduler``: address of a Dask scheduler; empty: so many ``workers`` of this machine, 0: one a core. Raises
    ConfigError where there is none or its workers have another version, MissingExtra.
    """
    missing = store.missing(batches(scenario))
    whole = scenario.flights
    done = whole - sum(map(len, missing))
    progress(done, whole)
    if not missing:
        return []
    troubles = []
    with _client(scheduler, min(workers or os.cpu_count() or 1, len(missing))) as (client, as_completed):
        flown = {client.submit(fly, scenario, batch, pure=False, retries=_RETRIES): batch for batch in missing}
        for future in as_completed(list(flown)):
            batch = flown.pop(future)
            if future.status == "finished":
                store.put(batch, future.result())
                done += len(batch)
                progress(done, whole)
            else:
                troubles.append(f"flights {batch[0]} to {batch[-1]}: {future.exception()!r}")
            future.release()
    return troubles


@contextlib.contextmanager
def _client(scheduler: str, workers: int) -> Iterator[tuple[Any, Any]]:
    try:
        from distributed import Client, LocalCluster, as_completed
    except ImportError as error:
        raise MissingExtra("campaigns need dask: pip install nff-companion[sim]") from error
    if scheduler:
        try:
            client = Client(scheduler, timeout=_CONNECT_S)
        except (OSError, TimeoutError, ValueError) as error:
            raise ConfigError(f"scheduler {scheduler!r} does not answer: {error}") from error
        with client:
            _alike(client.run(version))
            yield client, as_completed
        return
    cluster = LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None, memory_limit=0)
    with cluster, Client(cluster) as client:
        yield client, as_completed


def version() -> str:
    """What a worker flies."""
    from importlib import metadata

    return metadata.version("nff-companion")


def _alike(found: dict[str, str]) -> None:
    """Raises ConfigError."""
    if not found:
        raise ConfigError("the scheduler has no workers: start one or more (`dask worker ADDRESS`)")
    for worker, its in found.items():
        if its != version():
            raise ConfigError(f"worker {worker} has nff-companion {its}, this is {version()}: install the same")
