"""A benchmark: a problem, a start, the best cost known, and the recorded runs of the solvers."""

import difflib
import functools
import inspect
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float

from .._problem import Problem
from ._library import LIBRARY

RECORDS = Path(__file__).with_name("_records.json")
REACHED = {"float64": 1e-6, "float32": 1e-3}
"""How far above the optimum, relative to it, a run may end and count as having reached it."""


class Run(NamedTuple):
    """How one solver ended on a benchmark: a status's name, iterations done, and the cost.

    `fewest` and `most` are the iterations from starts that differ from the benchmark's by rounding
    alone: where they are far apart, so will be those on another processor.
    """

    status: str
    iterations: int
    cost: float
    fewest: int
    most: int


@dataclass(frozen=True, repr=False)
class Benchmark:
    """Hold a problem with its start, its optimum, and what the solvers did with it.

    Arguments:
        name: the name it is loaded by.
        source: where it comes from.
        statement: the problem in words and equations, with all its numbers.
        problem: the problem; its arrays have the float type of the moment.
        x0: starting state, shape (nx,). us: starting controls, shape (T, nu).
        optimum: the best cost known: that of IPOPT (double precision, tolerance 1e-10) on the same
            discretised problem, started from `us`, from the solvers' solutions, and, where there
            are several optima, from the best of many random starts.
        optimum_by: which of these starts it is.
        runs: recorded runs by (solver, dtype), such as ("ILQR", "float64"), with default options
            and XLA's default flags.
        made_with: versions of the programs that made the record.

    Printed, it is the statement and a table of the runs.
    """

    name: str
    source: str
    statement: str
    problem: Problem
    x0: Float[Array, " nx"]
    us: Float[Array, "T nu"]
    optimum: float
    optimum_by: str
    runs: dict[tuple[str, str], Run]
    made_with: dict[str, str]

    @property
    def iterations(self) -> dict[tuple[str, str], int]:
        """The recorded iterations by (solver, dtype), whether the run reached the optimum or not.

        Another processor or version of JAX rounds differently: see `Run.fewest` and `Run.most`.
        """
        return {key: run.iterations for key, run in self.runs.items()}

    def excess(self, cost: float) -> float:
        """Return how far a cost lies above the optimum, relative to it."""
        return cost / self.optimum - 1

    def reached(self, solver: str, dtype: str = "float64") -> bool:
        """Tell whether the recorded run of a solver came to the optimum.

        That is within 1e-6 of it in float64, and 1e-3 in float32. Raises KeyError for a run that
        is not recorded.
        """
        return self.excess(self.runs[solver, dtype].cost) <= REACHED[dtype]

    def __str__(self) -> str:
        T, nu = self.us.shape
        bounds = "no bounds" if self.problem.bounds is None else "bounds on the controls"
        lines = [
            f"{self.name}: {self.statement}",
            "",
            f"Source: {self.source}",
            f"T = {T}, dt = {float(np.asarray(self.problem.dt)):.6g} s, nx = {self.x0.shape[0]}, "
            f"nu = {nu}, {bounds}",
            f"optimum {self.optimum:.10g}, by {self.optimum_by}",
            "",
            f"{'solver':<8}{'dtype':<9}{'iterations':>10}{'near starts':>13}"
            f"{'above optimum':>15}  status",
        ]
        for (solver, dtype), run in self.runs.items():
            lines.append(
                f"{solver:<8}{dtype:<9}{run.iterations:>10}{f'{run.fewest} to {run.most}':>13}"
                f"{self.excess(run.cost):>15.1e}  {run.status}"
            )
        lines.append("float32 stops within looser tolerances, hence after fewer iterations")
        lines.append("recorded with " + ", ".join(f"{k} {v}" for k, v in self.made_with.items()))
        return "\n".join(lines)

    __repr__ = __str__


@functools.cache
def _records() -> dict[str, Any]:
    return json.loads(RECORDS.read_text(encoding="utf-8"))


def names() -> tuple[str, ...]:
    """Return the names of all benchmarks."""
    return tuple(LIBRARY)


def load(name: str) -> Benchmark:
    """Return a benchmark by its name.

    Its arrays are made at the call: in float64 where the application has enabled x64, else in
    float32. Raises ValueError for an unknown name, saying which is nearest.
    """
    if name not in LIBRARY:
        near = difflib.get_close_matches(str(name), LIBRARY, n=1, cutoff=0.0)
        raise ValueError(
            f"name: got {name!r}; the nearest benchmark is {near[0]!r}, all are "
            + ", ".join(LIBRARY)
        )
    source, build = LIBRARY[name]
    problem, x0, us = build()
    record = _records()["benchmarks"][name]
    runs = {tuple(key.split()): Run(**run) for key, run in record["runs"].items()}
    return Benchmark(
        name=name,
        source=source,
        statement=inspect.getdoc(build) or "",
        problem=problem,
        x0=x0,
        us=us,
        optimum=record["optimum"],
        optimum_by=record["optimum_by"],
        runs=runs,
        made_with=_records()["made_with"],
    )
