"""Put the figures of the suite `peers` beside the best costs and the bars they are held to."""

import math
import statistics
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from jaxctrl.bench._bars import held

from .build import LABELS

Record = dict[str, Any]
OURS = ("ILQR", "DDP")
NEAR = 1.001
"""A restart has succeeded within this factor of the best cost."""
CROCODDYL = {"P1": 0.3, "P2": 0.5, "P3": 0.4, "P3h": 0.8}
FLOOR = {"P1": 1.3, "P3f": 1.3, "P2": 2.0}
DEFAULT = {"P1": 2.0, "P2": 2.0, "P3": 2.0}
RESTARTS = {"P1": ("one solve", 60.0), "P3": ("one solve", 60.0), "P2": ("Crocoddyl", 1.0)}
"""In wall time on both sides: ours are shared among two devices, whose processor times add up."""
SUCCESS = {"P1": 0.94, "P2": 0.98, "P3": 0.99, "P3h": 0.98}
FIRST = {"P1": 1.0, "P2": 1.0, "P3": 2.5}
GRADIENTS = {"cost": 1.0, "trajectory": 3.0}


def best_costs(records: Iterable[Record]) -> dict[str, float]:
    """Return each problem's best cost: the best known or, if lower, anybody's in this run."""
    best: dict[str, float] = {}
    for record in records:
        if record["section"] in ("single", "restarts"):
            costs = [*record.get("costs", ()), *(record.get(k) for k in ("cost", "limit", "best"))]
            finite = [cost for cost in costs if cost is not None and math.isfinite(cost)]
            best[record["problem"]] = min([best.get(record["problem"], math.inf), *finite])
    return best


def add_success(records: Iterable[Record], best: dict[str, float]) -> None:
    """Compare costs with the best: ratios of single solves, successes of restarts."""
    for record in records:
        if record["section"] == "single":
            # A null was no finite number.
            cost = math.inf if record["cost"] is None else record["cost"]
            record["ratio"] = cost / best[record["problem"]]
        elif record["section"] == "restarts":
            near = [
                cost is not None and cost <= NEAR * best[record["problem"]]
                for cost in record["costs"]
            ]
            both = [a and b for a, b in zip(near, record["ok"], strict=True)]
            record["by_cost"], record["success"] = statistics.mean(near), statistics.mean(both)
            record.setdefault("total_ms", record.get("timing", {}).get("ms"))
            record["iterations_median"] = statistics.median(record["iterations"])
            record["iterations_max"] = max(record["iterations"])


def ms(record: Record) -> float:
    """Return a single solve's median processor time [ms], the wall time of a quiet machine."""
    return record["timing"]["cpu_ms"]


class Figures:
    """The records of a run, to be asked for one."""

    def __init__(self, records: Sequence[Record]):
        self.records = records

    def get(self, section: str, mode: str, problem: str, solver: str) -> Record | None:
        """Return one record, or None."""
        wanted = (section, mode, problem, solver)
        for r in self.records:
            if (r["section"], r.get("mode"), r.get("problem"), r.get("solver")) == wanted:
                return r
        return None

    def ours(self, section: str, mode: str, problem: str) -> list[Record]:
        """Return our solvers' records that there are."""
        found = (self.get(section, mode, problem, solver) for solver in OURS)
        return [record for record in found if record is not None]

    def fastest(self, mode: str, problem: str) -> Record | None:
        """Return our faster single solve, among those that converged to the best cost."""
        fine = [r for r in self.ours("single", mode, problem) if r["ok"] and r["ratio"] <= NEAR]
        return min(fine, key=ms, default=None)

    def restarted(self, problem: str) -> Record | None:
        """Return our restarts: the faster solver of those successful enough, or the surest."""
        found = self.ours("restarts", "fast", problem)
        enough = [r for r in found if r["success"] >= SUCCESS[problem]]
        if enough:
            return min(enough, key=lambda r: r["total_ms"])
        return max(found, key=lambda r: r["success"], default=None)

    def crocoddyl_restarts(self, problem: str) -> Record | None:
        """Return the faster of Crocoddyl's two kinds of start."""
        kinds = [
            self.get("restarts", "peer", problem, f"Crocoddyl{kind}") for kind in ("", " feasible")
        ]
        return min(filter(None, kinds), key=lambda r: r["total_ms"], default=None)


def bars(figures: Figures, names: Sequence[str], restarts: int) -> Iterator[Record]:
    """Yield each bar of the problems in `names` with the figure that is held to it."""

    def row(what, problem, record, value, bar, least=False):
        return held(what, problem, "-" if record is None else record["solver"], value, bar, least)

    def ratio(record, key, other, other_key):
        return None if record is None or other is None else record[key] / other[other_key]

    singles = (
        ("one solve, fast / Crocoddyl", "fast", LABELS["crocoddyl_peer"], CROCODDYL),
        ("one solve, fast / floor", "fast", LABELS["floor_peer"], FLOOR),
        ("one solve, default / Crocoddyl", "default", LABELS["crocoddyl_peer"], DEFAULT),
    )
    for what, mode, peer, limits in singles:
        for name in filter(limits.get, names):
            record, other = figures.fastest(mode, name), figures.get("single", "peer", name, peer)
            value = None if record is None or other is None else ms(record) / ms(other)
            shown = row(what, name, record, value, limits[name])
            # Figures there are, but none of a solve that converged to the best cost.
            failed = record is None and figures.ours("single", mode, name)
            yield {**shown, "verdict": "MISSED"} if failed else shown
    for name in filter(RESTARTS.get, names):
        record, (unit, bar) = figures.restarted(name), RESTARTS[name]
        other, key = figures.crocoddyl_restarts(name), "total_ms"
        value = ratio(record, key, other, key)
        if unit == "one solve":
            value = None if record is None else record["of_one"]
        yield row(f"{restarts} restarts, fast / {unit}", name, record, value, bar)
    for name in filter(SUCCESS.get, names):
        record = figures.restarted(name)
        value = None if record is None else record["success"]
        yield row(f"success of {restarts} restarts", name, record, value, SUCCESS[name], True)
    for name in filter(FIRST.get, names):
        for record in figures.ours("single", "fast", name):
            yield row("first call, fast [s]", name, record, record["first_s"], FIRST[name])
    for mode in ("fast", "default"):
        for name in names:
            for record in figures.ours("gradients", mode, name):
                for of, bar in GRADIENTS.items():
                    what = f"gradient of {of}, {mode} [iterations]"
                    yield row(what, name, record, record[of], bar)
