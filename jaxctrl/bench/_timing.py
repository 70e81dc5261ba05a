"""Time calls in turns beside a fixed piece of work, and sum up what they took.

The machine's speed drifts, and other programs take its cores. So `calibrate` is run between any two
calls, and each is also given in units of that: `relative` is the processor time of a call over that
of the calibrations just before and after it.
"""

import itertools
import statistics
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..stopwatch import Taken, count_for, repeated, take

BLOCK = 3e-3
"""Calls are repeated until they take this long [s]: far above the clock's resolution."""
_INPUT = np.linspace(0.1, 1.0, 256)


def calibrate() -> None:
    """Do the fixed work, some 4 ms: arithmetic in the cache, an interpreter's loop, small arrays.

    A solve is made of much the same. Alone, each kind followed the speed of solves under other
    programs' load about as well (standard deviations of 2 to 5 % between processes).
    """
    y = _INPUT
    for _ in range(500):
        y = np.sqrt(np.exp(0.5 * np.sin(y))) * _INPUT + 0.1
    a, table = 0.3, [0.0] * 64
    for i in range(12000):
        a = 3.7 * a * (1 - a)
        table[i & 63] += a
    parts: dict[int, Any] = {}
    for i in range(600):
        part = np.empty(64 + (i & 255))
        part.fill(a)
        parts[i & 63] = (part, part + y[0])


def measure(
    calls: Sequence[Callable[[], Any]], rounds: int, budget: float = np.inf
) -> list[dict[str, Any]]:
    """Time calls, warm, in turns, so that drifts meet all alike.

    Arguments:
        calls: each must not return before its work is done; one that returns `Taken` is believed.
        rounds: how many turns each has.
        budget: a call that has used this up [s] is left out of further rounds after its third.

    Returns: for each call `timing`, a dict that JSON can hold.
    """
    times = [repeated(call) for call in calls]
    counts = [count_for(call, BLOCK) for call in times]
    taken: list[list[Taken]] = [[] for _ in calls]
    relative: list[list[float]] = [[] for _ in calls]
    fixed = repeated(calibrate)
    before = take(fixed).cpu
    for turn in range(rounds):
        for i, call in enumerate(times):
            if turn >= 3 and sum(t.wall for t in taken[i]) * counts[i] > budget:
                continue
            taken[i].append(take(call, counts[i]))
            after = take(fixed).cpu
            relative[i].append(2 * taken[i][-1].cpu / (before + after))
            before = after
    return [timing([each], [ratios]) for each, ratios in zip(taken, relative, strict=True)]


def timing(taken: list[list[Taken]], relative: list[list[float]]) -> dict[str, Any]:
    """Sum up what a call took, for each process round by round, in a dict that JSON can hold.

    It has the median wall time `ms` and its 10 % and 90 % quantiles, the median processor time
    `cpu_ms` (on one core the wall time without other programs), and the lists themselves.
    """
    return _sum_up(
        {
            "walls_ms": [[_short(1e3 * each.wall) for each in rounds] for rounds in taken],
            "cpus_ms": [[_short(1e3 * each.cpu) for each in rounds] for rounds in taken],
            "relative": [[_short(value) for value in rounds] for rounds in relative],
        }
    )


def merge(first: dict[str, Any], more: dict[str, Any]) -> dict[str, Any]:
    """Return the timing of two sets of processes."""
    return _sum_up({name: first[name] + more[name] for name in ("walls_ms", "cpus_ms", "relative")})


def _short(value: float) -> float:
    return float(f"{value:.5g}")


def _sum_up(lists: dict[str, list[list[float]]]) -> dict[str, Any]:
    walls, cpus = (list(itertools.chain(*lists[name])) for name in ("walls_ms", "cpus_ms"))
    low, high = np.quantile(walls, [0.1, 0.9])
    medians = {"ms": statistics.median(walls), "cpu_ms": statistics.median(cpus)}
    return {**medians, "low_ms": float(low), "high_ms": float(high), **lists}
