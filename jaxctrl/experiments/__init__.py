"""Published figures and tables as programs: a registry of names, each imported at first use.

A module of the registry exports `Config` (a frozen dataclass of Python scalars and strings, with a
class method `quick()`), `run(config) -> Result`, `figure(result) -> Figure` and
`claims(result) -> list[Claim]`. Nothing here imports JAX, so that `jaxctrl list` answers at once.
"""

import difflib
import importlib
from collections.abc import Iterable
from types import ModuleType

EXPERIMENTS: dict[str, tuple[str, str]] = {
    "fig-3.4": (
        "jaxctrl.experiments.fig_3_4",
        "Free movements under minimum torque change (3.4) and minimum energy (3.5)",
    ),
    "fig-3.6": (
        "jaxctrl.experiments.fig_3_6",
        "Through mirror-image via-points: minimum torque change (3.6) and energy (3.7)",
    ),
    "fig-3.8": (
        "jaxctrl.experiments.fig_3_8",
        "Via-points near and far: minimum torque change (3.8) and energy (3.9)",
    ),
    "fig-3.10": (
        "jaxctrl.experiments.fig_3_10",
        "One via-point at several times: minimum torque change (3.10) and energy (3.11)",
    ),
    "fig-4.1": (
        "jaxctrl.experiments.fig_4_1",
        "Optimal trajectories of the torque arm, the muscle arm and the pendulum",
    ),
    "fig-4.2": (
        "jaxctrl.experiments.fig_4_2",
        "Joint paths of the muscle arm over the iterations of ILQR",
    ),
    "fig-4.3": (
        "jaxctrl.experiments.fig_4_3",
        "Cost against time for ILQR, DDP and gradient methods on the muscle arm",
    ),
    "fig-4.4": (
        "jaxctrl.experiments.fig_4_4",
        "Both arms from 100 random controls: how many find the best optimum",
    ),
    "table-4.1": (
        "jaxctrl.experiments.table_4_1",
        "Time and iterations of ILQR, DDP, gradient methods and collocation on three problems",
    ),
    "centre-out": (
        "jaxctrl.experiments.centre_out",
        "10 cm reaches in 8 directions with both arms",
    ),
    "two-thirds": (
        "jaxctrl.experiments.two_thirds",
        "The two-thirds power law on closed paths traced optimally, with their timing free",
    ),
    "curvature-map": (
        "jaxctrl.experiments.curvature_map",
        "Curvature of 10 cm reaches over the workspace, under two models",
    ),
}
"""Name of each experiment, its module and one line about it."""

ALIASES = {"fig-3.5": "fig-3.4", "fig-3.7": "fig-3.6", "fig-3.9": "fig-3.8", "fig-3.11": "fig-3.10"}
"""Figures that another experiment draws too: the same movements under another model."""


def resolve(name: str) -> str:
    """Return the experiment that draws a figure; any other name as it is."""
    return ALIASES.get(name, name)


def names() -> list[str]:
    """List the experiments in the order of the registry."""
    return list(EXPERIMENTS)


def load(name: str) -> ModuleType:
    """Import the module of an experiment.

    Raises: ValueError with the nearest name when there is no such experiment.
    """
    if name not in EXPERIMENTS:
        raise ValueError(unknown("experiment", name, names()))
    return importlib.import_module(EXPERIMENTS[name][0])


def unknown(kind: str, word: str, words: Iterable[str]) -> str:
    """Say that a word is none of the known words, and which of them is nearest to it."""
    words = list(words)
    near = difflib.get_close_matches(word, words, n=1)
    advice = f"did you mean {near[0]!r}?" if near else f"choose from {', '.join(words)}"
    return f"no {kind} {word!r}: {advice}"
