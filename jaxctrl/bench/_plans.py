"""What each suite measures: the orders of the processes that do it."""

from dataclasses import dataclass
from typing import Any

CASES = ("P1", "P2", "P3f", "P3", "P3h", "P4-4", "P4-8")
SOLVERS = ("ILQR", "DDP", "LBFGS", "ConjugateGradient")
FULL = {
    "firsts": 3, "rounds": 15, "budget": 20.0, "restarts": 100, "batches": 3, "processes": 3,
}  # fmt: skip
QUICK = {"firsts": 1, "rounds": 10, "budget": 2.0, "restarts": 4, "batches": 3, "processes": 2}


@dataclass(frozen=True)
class Job:
    """What one process measures.

    Arguments:
        orders: for `_worker`.
        again: the same for further processes, that measure the judged times anew; None where one
            process must do.
    """

    orders: dict[str, Any]
    again: dict[str, Any] | None


def jobs(suite: str, quick: bool, peers: bool) -> list[Job]:
    """Return the processes of a suite."""
    settings = QUICK if quick else FULL
    base = {"suite": suite, "mode": "fast", "dtype": "float64", "quick": quick, "peers": peers}
    base |= settings
    return {"thesis": _thesis, "peers": _peers, "scaling": _scaling, "problems": _problems}[suite](
        base, quick
    )


def _thesis(base: dict[str, Any], quick: bool) -> list[Job]:
    noise = {**base, "part": "noise"}
    return [Job({**base, "part": "table"}, None), Job(noise, noise)]


def _peers(base: dict[str, Any], quick: bool) -> list[Job]:
    """Plan both manners of compiling; the first one chooses tolerances for the second."""
    names = ["P2"] if quick else list(CASES)
    solvers = list(SOLVERS[:2] if quick else SOLVERS)
    common = {**base, "names": names, "solvers": solvers}
    newton = {**common, "peers": False, "solvers": list(SOLVERS[:2])}
    further = {**newton, "singles_alone": True, "firsts": 1}
    first = {**common, "peers": True, "singles_alone": False}
    # A trial need not compile everything twice.
    default = {**newton, "singles_alone": quick, "restarts": 0, "mode": "default"}
    return [Job(first, further), Job(default, {**further, "mode": "default"})]


def _scaling(base: dict[str, Any], quick: bool) -> list[Job]:
    horizons = [50, 200] if quick else [50, 100, 200, 500, 1000, 2000]
    links, sizes = ([2], [1, 16]) if quick else ([2, 4, 8, 16], [1, 16, 256, 4096])
    found = []
    for dtype in ("float64", "float32"):
        one = {**base, "dtype": dtype, "horizons": horizons, "links": links, "sizes": []}
        found.append(Job(one, one))
        for size in sizes:
            alone = {**one, "horizons": [], "links": [], "sizes": [size]}
            found.append(Job(alone, alone if size <= 16 and not quick else None))
    return found


def _problems(base: dict[str, Any], quick: bool) -> list[Job]:
    names = ["double-integrator", "pendulum", "torque-arm"] if quick else None
    orders = {**base, "names": names}
    return [Job(orders, {**orders, "peers": False})]
