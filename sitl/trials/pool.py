"""Processes that share the work of a trial out, and end with whoever asked for them, even when that is killed."""

from __future__ import annotations

import multiprocessing
import os
from multiprocessing.pool import Pool

from sitl.trials.launch import bind_to


def pool_of(count: int) -> Pool:
    """``count`` of them, each a new interpreter. On Linux they die with the thread that calls this."""
    return multiprocessing.get_context("spawn").Pool(count, initializer=bind_to, initargs=(os.getpid(),))
