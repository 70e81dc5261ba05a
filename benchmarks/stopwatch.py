"""Time calls, on one core or on all of them."""

import contextlib
import os
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

CORES = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def _pin(cores: Sequence[int]) -> None:
    """Let every thread of this process run on these cores alone."""
    # The system pins threads, not processes, and JAX has started its own before we get here.
    tasks = Path("/proc/self/task")
    threads = [int(entry.name) for entry in tasks.iterdir()] if tasks.is_dir() else [0]
    for thread in threads:
        with contextlib.suppress(OSError):  # it may have ended meanwhile
            os.sched_setaffinity(thread, cores)


@contextlib.contextmanager
def one_core() -> Iterator[None]:
    """Stay on one core, and so do processes begun meanwhile; nothing where the OS cannot."""
    if not CORES:
        yield
        return
    _pin(CORES[-1:])  # the first core is the one that most often serves interrupts
    try:
        yield
    finally:
        _pin(CORES)


def seconds(call: Callable[[], Any]) -> float:
    """Return how long one call takes [s]; it must not return before its work is done."""
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def measure(calls: Sequence[Callable[[], Any]], repeats: int) -> list[list[float]]:
    """Return the seconds of each call, warm; taken in turns, so that drifts meet all alike."""
    for call in calls:
        call()
    rounds = [[seconds(call) for call in calls] for _ in range(repeats)]
    return [list(taken) for taken in zip(*rounds, strict=True)]


def median_ms(taken: Sequence[float]) -> float:
    """Return the median of seconds, in milliseconds."""
    return 1e3 * statistics.median(taken)
