"""The suite `thesis`: table 4.1, by the experiment that reproduces it, and times under noise."""

from typing import Any

import numpy as np

from .. import experiments
from ..stopwatch import Taken
from . import _under_noise
from ._timing import timing
from ._worker import Emitter

TABLE = "table-4.1"


def run(orders: dict[str, Any], emit: Emitter) -> None:
    """Carry out the orders."""
    {"table": table_4_1, "noise": _under_noise.run}[orders["part"]](orders, emit)


def table_4_1(orders: dict[str, Any], emit: Emitter) -> None:
    """Run the experiment; hand over its times, its table and its claims."""
    try:
        table = experiments.load(TABLE)
        result = table.run(table.Config.quick() if orders["quick"] else table.Config())
        claims = table.claims(result)
    except Exception as error:
        emit.failure(TABLE, error)
        return
    data = result.data
    for problem in data["problem"].values:
        for method in data["solver"].values:
            cell = data.sel({"problem": problem, "solver": method})
            near = [i for i, s in enumerate(cell.seconds.values) if np.isfinite(s)]
            figures: dict[str, Any] = {"note": "never near the best cost"}
            if near:  # the nearest that it came
                i = near[-1]
                middle, half, wall = (float(cell[k][i]) for k in ("seconds", "spread", "wall"))
                rounds = [Taken(t, wall) for t in (middle - half, middle, middle + half)]
                taken = timing([rounds], [])
                figures = {"timing": taken, "iterations": float(cell.iterations[i])}
                figures["note"] = f"within {float(data['near'][i]):g} of the best cost"
            emit(
                "single", problem=str(problem), solver=str(method), cost=float(cell.cost),
                optimum=float(cell.best), first_s=float(cell["first"]),
                status=str(cell.status.values), **figures,
            )  # fmt: skip
    emit("table", problem=TABLE, rows=[list(row) for row in table.table(result)])
    if result.failure:
        emit.failure(TABLE, RuntimeError(result.failure))
    for claim in claims:
        emit(
            "claim", problem=TABLE, statement=claim.statement, expected=claim.expected,
            measured=claim.measured, holds=claim.holds, note=claim.note,
        )  # fmt: skip
