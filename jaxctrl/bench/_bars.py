"""Bars that figures are held to, and those of the suite `thesis`, under noise."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

Record = dict[str, Any]
NUM_TRIALS, DIRECTIONS = 1000, 16
REACH, CUT, TRIALS = "reach", "reach, 1 iteration", f"{NUM_TRIALS} trials"
BATCH, LOOP = f"{DIRECTIONS} reaches, batch", f"{DIRECTIONS} reaches, loop"
"""Names of what the suite `thesis` measures under noise."""
ITERATION = 2.0
"""Most that an iteration of ILQG may take, in iterations of ILQR."""
TRIALS_MS = 60.0
"""Most that the trials may take [ms]."""
LANES = 16.0
"""Most that the batch may take, in solves of one reach: the mean of all directions."""


def held(
    what: str, problem: str, by: str, figure: float | None, bar: float, least: bool = False
) -> Record:
    """Return the record of a bar: the figure that is held to it, or None, and the verdict.

    The bar is the least or the most that the figure may be.
    """
    if figure is None or math.isnan(figure):
        figure, verdict = None, "not measured"
    else:
        verdict = "met" if (figure >= bar if least else figure <= bar) else "MISSED"
    return {
        "what": what, "problem": problem, "by": by, "figure": figure, "bar": bar, "least": least,
        "verdict": verdict,
    }  # fmt: skip


def of_noise(rows: Sequence[Record]) -> Iterator[Record]:
    """Yield the bars of chapter 5, by processor time on one core.

    An iteration is the difference between a solve and the same cut after its first iteration, over
    the iterations between: what a solve takes before and after its iterations is in both.
    """
    found = {(r["problem"], r["solver"]): r for r in rows if r["section"] == "noise"}

    def ms(problem: str, solver: str) -> float:
        record = found.get((problem, solver))
        return math.nan if record is None else record["timing"]["cpu_ms"]

    def iteration(solver: str) -> float:
        count = found.get((REACH, solver), {}).get("iterations", 0)
        return (ms(REACH, solver) - ms(CUT, solver)) / (count - 1) if count > 1 else math.nan

    ratio, one = iteration("ILQG") / iteration("ILQR"), ms(LOOP, "ILQG") / DIRECTIONS
    yield held("one iteration, ILQG / ILQR", REACH, "ILQG", ratio, ITERATION)
    yield held("trials [ms]", TRIALS, "evaluate", ms(TRIALS, "evaluate"), TRIALS_MS)
    yield held("batch / one solve", BATCH, "ILQG", ms(BATCH, "ILQG") / one, LANES)
