"""The same problems through other programs: what is here, and how each is called.

All costs are computed anew by `Case.cost`. A rival stops by our rule as far as it can be told to.
"""

import importlib.util
import json
import os
import statistics
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jaxctrl.stopwatch import Taken, one_core

from .build import LABELS, PEERS, TH_STOP, build
from .cases import Case

MAXITER = 500
FACTORS = {"P1": "1e2", "P2": "1e2", "P3": "1e2", "P3h": "2e3"}
"""crocoddyl_peer's own factors on the cost, which must be repeated to ask for a feasible start."""
TRANSCRIBERS = {"CasADi + IPOPT": "ipopt", "CasADi + fatrop": "fatrop"}
TRANSCRIBED = ("P1", "P2", "P3f", "P3", "P3h")
"""Cases whose dynamics CasADi can state: those of chains solve a linear system in NumPy or JAX."""


@dataclass
class Program:
    """A rival, ready to solve one case: a call to be timed, and what it found."""

    label: str
    call: Callable[[], Any]
    found: Callable[[], tuple[np.ndarray, dict[str, Any]]]
    """Returns the controls (T, nu) of the last call, and further figures."""
    figures: dict[str, Any] = field(default_factory=dict)


def cache() -> Path:
    """Return the folder of compiled programs, the user's own."""
    root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(root, "jaxctrl", "peers")


def compile_peers() -> tuple[dict[str, Path], dict[str, str]]:
    """Compile the C++ peers that can be; return them, and a reason for each of the others."""
    try:
        built, reasons = build(cache())
    except OSError as error:
        built, reasons = {}, dict.fromkeys(PEERS, str(error))
    return built, {LABELS[name]: reason for name, reason in reasons.items()}


def missing_packages() -> dict[str, str]:
    """Return a reason for each rival whose Python package is not here."""
    lacks: dict[str, str] = {}
    if importlib.util.find_spec("casadi") is None:
        lacks |= {label: "pip install casadi" for label in TRANSCRIBERS}
    else:
        import casadi

        for label, plugin in TRANSCRIBERS.items():
            if not casadi.has_nlpsol(plugin):
                lacks[label] = f"this CasADi was built without {plugin} (pip install -U casadi)"
    return lacks


def run_peer(
    program: Path, name: str, uss: np.ndarray, repeats: int, *more: str
) -> tuple[dict[str, Any], np.ndarray]:
    """Run a C++ peer from the starts uss (B, T, nu); return its word and its us."""
    with tempfile.TemporaryDirectory() as folder:
        files = [str(Path(folder, file)) for file in ("start", "found")]
        np.ascontiguousarray(uss, float).tofile(files[0])
        numbers = [str(repeats), repr(TH_STOP[program.name][name]), str(MAXITER)]
        line = [str(program), name, *files, *numbers, *more]
        run = subprocess.run(line, capture_output=True, text=True)
        if run.returncode != 0:
            raise RuntimeError(f"{program.name} {name}: {run.stderr.strip()[:300]}")
        return json.loads(run.stdout), np.fromfile(files[1]).reshape(uss.shape)


def compiled(program: Path, name: str, case: Case) -> Program:
    """Return a C++ peer; it times itself, without its start."""
    last: list[Any] = [None, None]

    def call() -> Taken:
        last[0], us = run_peer(program, name, case.start[None], 5)
        last[1] = us[0]
        return Taken(*(statistics.median(last[0][clock]) for clock in Taken._fields))

    return Program(
        LABELS[program.name], call, lambda: (last[1], {"iterations": last[0]["iterations"][0]})
    )


def programs(
    name: str, case: Case, built: dict[str, Path], lacks: dict[str, str]
) -> Iterator[Callable[[], Program]]:
    """Yield what makes each rival that is here ready for one case."""
    for program in built.values():
        if name in TH_STOP[program.name]:
            yield lambda program=program: compiled(program, name, case)
    for label, plugin in TRANSCRIBERS.items():
        if label not in lacks and name in TRANSCRIBED:
            from .transcribed import transcribed

            yield lambda label=label, plugin=plugin: transcribed(label, plugin, case)
    from .minimised import minimised

    yield lambda: minimised(case.problem(), case.x0, case.start)


def crocoddyl_restarts(
    program: Path, name: str, case: Case, count: int, repeats: int
) -> Iterator[dict[str, Any]]:
    """Solve from many starts by Crocoddyl on one thread; yield figures for both kinds of start."""
    starts = case.starts(name, count)
    for kind, more in (("", ()), (" feasible", (FACTORS[name], "feasible"))):
        with one_core():
            word, us = run_peer(program, name, starts, repeats, *more)
        threshold = TH_STOP[program.name][name]
        yield {
            "solver": f"Crocoddyl{kind}", "mode": "peer", "devices": 1,
            "total_ms": 1e3 * statistics.median(word["wall"]),
            "cpu_ms": 1e3 * statistics.median(word["cpu"]), "iterations": word["iterations"],
            "ok": [stop is not None and stop <= threshold for stop in word["stop"]],
            "costs": [float(case.cost(each)) for each in us],
        }  # fmt: skip
