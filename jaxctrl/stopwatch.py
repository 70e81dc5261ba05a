"""Time calls on one core, in turns, by the processor's clock, with the wall's beside it.

The machine's speed drifts and other programs take its cores. So calls that are to be compared are
taken in turns, and what is compared is processor time, which on one core is the wall time of an
idle machine.

calls = [stopwatch.repeated(call) for call in (first, second)]
cpu, wall = stopwatch.in_turns(calls, 15)    # seconds, each (15, 2)
"""

import contextlib
import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

CORES = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
"""The cores that this process may run on; none where the system does not tell."""


class Taken(NamedTuple):
    """What something took [s]: processor time of this process, and wall time.

    Numbers, or arrays of one shape. A call that returns this has timed itself, as a program in a
    process of its own does, and is believed.
    """

    cpu: Any
    wall: Any


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
    """Stay on one core inside a `with` block, and so do processes begun meanwhile.

    Does nothing where the system cannot.
    """
    if not CORES:
        yield
        return
    _pin(CORES[-1:])  # the first core is the one that most often serves interrupts
    try:
        yield
    finally:
        _pin(CORES)


def repeated(call: Callable[[], Any]) -> Callable[[int], Any]:
    """Return a function that makes a call as often as told, for `take` and `in_turns`."""

    def times(count: int):
        for _ in range(count - 1):
            call()
        return call()

    return times


def take(call: Callable[[int], Any], count: int = 1) -> Taken:
    """Time what does something `count` times; return what doing it once takes.

    It must not return before its work is done; if it returns `Taken`, that is it.
    """
    wall, cpu = time.perf_counter(), time.process_time()
    found = call(count)
    taken = (time.process_time() - cpu) / count, (time.perf_counter() - wall) / count
    return found if isinstance(found, Taken) else Taken(*taken)


def count_for(call: Callable[[int], Any], block: float) -> int:
    """Return how often to do something so that it takes so long [s]; it is done a few times."""
    call(1)
    once = take(call).cpu
    if once < block:  # what has interrupted one call will hardly have met all three
        once = min(once, *(take(call).cpu for _ in range(2)))
    return max(1, int(np.ceil(block / max(once, 1e-6))))


def in_turns(calls: Sequence[Callable[[int], Any]], rounds: int, block: float = 5e-3) -> Taken:
    """Time several calls, warm, on one core, in turns, so that what disturbs them meets all alike.

    Each is made once before every time that counts, and so fetches into the caches what the others
    have displaced.

    Arguments:
        calls: each does something as often as it is told, and returns when that is done.
        rounds: how many turns each has.
        block: a call is told to repeat until it takes this long [s], far above the clock's steps.

    Returns: `Taken` for doing it once, arrays of shape (rounds, calls).
    """
    times = np.empty((2, rounds, len(calls)))
    with one_core():
        counts = [count_for(call, block) for call in calls]
        for turn in range(rounds):
            for i, (call, count) in enumerate(zip(calls, counts, strict=True)):
                call(1)
                times[:, turn, i] = take(call, count)
    return Taken(*times)
