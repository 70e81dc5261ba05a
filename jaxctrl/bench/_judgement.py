"""Tell whether a time has changed: the statistic behind `--against`.

What is compared is each row's processor time in units of the calibration that was run around it
(`_timing`), so that neither another program's load nor a faster machine counts as a change. A
row is measured in a few processes, and in each over several rounds:

    m = median over the processes of the median over the rounds of log(relative)
    e = the largest of 1.25 s/sqrt(n) over the rounds and, where there are three processes or more,
        over the processes' medians
    slower if m_new - m_old > max(log(MARGIN + START/t_old), 4 sqrt(e_old^2 + e_new^2))

with s a normal distribution's standard deviation of the same median distance from the median, and n
the number. From one run to another the same solve of 2 ms differed by up to 5 %, under whatever
load: that is what MARGIN covers; one of 0.3 ms by up to 25 %, because most of it is JAX's start of
a call, which hands the work to another thread: that is what START covers, t_old being the earlier
processor time.
"""

import math
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from . import _timing

MARGIN = 1.15
"""A smaller ratio of times is taken for no change."""
START = 0.05
"""Nor is a difference of so many milliseconds more than MARGIN."""
SPREADS = 4.0
"""Nor is a difference below so many standard errors."""
TOO_NOISY = 1.5
"""A row with standard errors beyond this ratio cannot be judged."""
KEY = ("suite", "section", "problem", "solver", "mode", "dtype")
"""What two rows must share to be compared."""

Row = dict[str, Any]


def key(row: Row) -> tuple[str, ...]:
    """Return what names a row."""
    return tuple(str(row.get(part, "")) for part in KEY)


@dataclass(frozen=True)
class Centre:
    """Hold where the logarithms of a row's relative times lie, and how surely."""

    log: float
    error: float


def centre(processes: Sequence[Sequence[float]]) -> Centre:
    """Find the centre of relative times, one list for each process."""
    logs = [[math.log(value) for value in rounds] for rounds in processes if rounds]
    medians = [statistics.median(rounds) for rounds in logs]
    middle = statistics.median(medians)
    rounds = [value - m for each, m in zip(logs, medians, strict=True) for value in each]
    error = _error(rounds)
    if len(medians) > 2:
        error = max(error, _error([m - middle for m in medians]))
    return Centre(middle, error)


def _error(residuals: Sequence[float]) -> float:
    """Return the standard error of a median; outliers hardly change it."""
    spread = 1.4826 * statistics.median(map(abs, residuals))
    return 1.25 * spread / math.sqrt(len(residuals))


@dataclass(frozen=True)
class Judgement:
    """Hold a row's change: `ratio` new to old in units of the calibration, and what it means.

    `verdict` is "slower", "faster", "same", "too noisy", or "-" for what is not judged: other
    programs, and rows that were measured without a calibration (their ratio is of wall times).
    """

    name: tuple[str, ...]
    old: Row
    new: Row
    ratio: float
    threshold: float
    verdict: str


def judge(old: Row, new: Row) -> Judgement:
    """Compare one row of two runs."""
    if not all(any(row["timing"]["relative"]) for row in (old, new)):
        ratio = new["timing"]["ms"] / old["timing"]["ms"]
        return Judgement(key(new), old, new, ratio, math.nan, "-")
    a, b = (centre(row["timing"]["relative"]) for row in (old, new))
    change = b.log - a.log
    margin = MARGIN + START / old["timing"]["cpu_ms"]
    noise = SPREADS * math.hypot(a.error, b.error)
    threshold = max(math.log(margin), noise)
    if new.get("mode") == "peer":
        verdict = "-"
    elif change > threshold:
        verdict = "slower"
    elif change < -threshold:
        verdict = "faster"
    else:
        verdict = "too noisy" if noise > math.log(TOO_NOISY) else "same"
    return Judgement(key(new), old, new, math.exp(change), math.exp(threshold), verdict)


def judge_all(old: Sequence[Row], new: Sequence[Row]) -> Iterator[Judgement]:
    """Compare the timed rows that both runs have, in the order of the new one."""
    known = {key(row): row for row in old if "timing" in row}
    for row in new:
        if "timing" in row and key(row) in known:
            yield judge(known[key(row)], row)


def merge(rows: Sequence[Row], again: Sequence[Row]) -> None:
    """Add what further processes measured to the rows of the same names, in place."""
    more = {key(row): row["timing"] for row in again if "timing" in row}
    for row in rows:
        if "timing" in row and key(row) in more:
            row["timing"] = _timing.merge(row["timing"], more[key(row)])
