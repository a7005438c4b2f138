"""How plant, sensors, wind and autopilot are compiled, and where their machine code is kept.

Compiled are plain loops over vehicles and motors, by numba, without fast-math, and divided as numpy divides (by zero:
inf or nan). A ``part`` is compiled into the kernels that call it; a ``kernel`` is what Python calls. Machine code of
kernels is kept in ``__pycache__``, in the user's cache where that cannot be written, or under ``NUMBA_CACHE_DIR`` where
that is set. Each kernel has one signature: arrays are contiguous, and hold float64, bool, int64 or records. So whoever
compiles at the same time writes the same, each file at once.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from nff_companion.errors import MissingExtra

try:
    import numba
    from numba.core.caching import InTreeCacheLocator, UserProvidedCacheLocator, UserWideCacheLocator
except ImportError as error:
    raise MissingExtra("the emulated vehicle needs numba: pip install 'nff-companion[sim]'") from error

_FOLDER = Path(__file__).parent
_Function = TypeVar("_Function", bound=Callable[..., Any])


@functools.cache
def _sources() -> str:
    """Of all that can be in a kernel: numba looks at the kernel's own file alone, and parts are in other files."""
    digest = hashlib.sha256()
    for path in sorted((*_FOLDER.glob("*.py"), *_FOLDER.glob("autopilot/*.py"))):
        digest.update(path.read_bytes())
    return digest.hexdigest()


class _OfAllSources:
    """Files of other sources have other names: no process takes old machine code while another writes the new."""

    def get_source_stamp(self) -> str:
        return _sources()

    def get_disambiguator(self) -> str:
        return _sources()[:16]


class Provided(_OfAllSources, UserProvidedCacheLocator):
    """NUMBA_CACHE_DIR."""


class InTree(_OfAllSources, InTreeCacheLocator):
    """``__pycache__`` beside the source."""


class UserWide(_OfAllSources, UserWideCacheLocator):
    """The user's cache."""


def part(function: _Function) -> _Function:
    """Compiled into each kernel that calls it."""
    return cast(_Function, numba.njit(error_model="numpy", forceinline=True)(function))


def kernel(function: _Function) -> _Function:
    """Compiled when it is first called, or by ``prepare``; kept for later processes."""
    before = numba.config.CACHE_LOCATOR_CLASSES
    numba.config.CACHE_LOCATOR_CLASSES = ",".join(f"{__name__}.{c.__name__}" for c in (Provided, InTree, UserWide))
    try:
        return cast(_Function, numba.njit(cache=True, error_model="numpy")(function))
    except RuntimeError:  # no folder can be written: each process compiles for itself
        return part(function)
    finally:
        numba.config.CACHE_LOCATOR_CLASSES = before


def prepare(function: Callable[..., Any], *arguments: Any) -> None:
    """Load or compile the kernel for arguments like these, once a process, without running it.

    From then on arguments of other types are refused (TypeError), instead of stopping a flight to compile for them.
    """
    dispatcher = cast(Any, function)
    if not dispatcher.signatures:
        dispatcher.compile(tuple(numba.typeof(argument) for argument in arguments))
        dispatcher.disable_compile()


def flat(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """As a contiguous array of float64: itself, where it is one."""
    return np.ascontiguousarray(values, np.float64)
