"""Published figures and tables as programs: a registry of names, each imported at first use.

An experiment is a module with `Config` (a frozen dataclass of Python scalars and strings, with a
class method `quick()`), `run(config) -> Result`, `figure(result) -> Figure` and
`claims(result) -> list[Claim]`: one of the registry, or a file of your own (docs/experiments.md).
Nothing here imports JAX, so that `jaxctrl list` answers at once.
"""

import difflib
import importlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import ModuleType

from . import _file
from ._result import Claim as Claim, Result as Result, named as named

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
    "chapter-3": (
        "jaxctrl.experiments.chapter_3",
        "All of chapter 3 with a linear active state and Brown's: which findings hang on it",
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
    "fig-5.1": (
        "jaxctrl.experiments.fig_5_1",
        "Reaches of the torque arm in 8 directions by ILQG, with the ellipses that it predicts",
    ),
    "fig-5.3": (
        "jaxctrl.experiments.fig_5_3",
        "Reaches of the torque arm planned by ILQG from 50 random control laws",
    ),
    "fig-5.5": (
        "jaxctrl.experiments.fig_5_5",
        "Ways of the torque arm round an obstacle: its weight, the duration, and motor noise",
    ),
    "fig-5.6": (
        "jaxctrl.experiments.fig_5_6",
        "Time of ILQR, ILQG, DDP and conjugate gradients on chains of one link to six",
    ),
    "fig-5.7": (
        "jaxctrl.experiments.fig_5_7",
        "Reaches of the muscle arm in 16 directions by ILQG: how each muscle is tuned",
    ),
    "fig-5.8": (
        "jaxctrl.experiments.fig_5_8",
        "Noisy reaches of the muscle arm without feedback, with ILQG's, and with ILQR's",
    ),
    "fig-5.10": (
        "jaxctrl.experiments.fig_5_10",
        "Reaches of the muscle arm planned by ILQG from 50 random control laws",
    ),
    "ablations-5.1": (
        "jaxctrl.experiments.ablations_5_1",
        "What section 5.1 claims of ILQG: noise as an energy cost, the recursion's true Hessian",
    ),
    "prediction": (
        "jaxctrl.experiments.prediction",
        "Costs and end points that ILQG predicts, and those of trials, from weak to strong noise",
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

ALIASES = {
    "fig-3.5": "fig-3.4",
    "fig-3.7": "fig-3.6",
    "fig-3.9": "fig-3.8",
    "fig-3.11": "fig-3.10",
}
"""Figures that another experiment draws too: the same movements under another model."""


def resolve(word: str) -> str:
    """Return the name under which results are kept: an alias's experiment, a file's stem."""
    return Path(word).stem if _file.is_file(word) else ALIASES.get(word, word)


def describe(word: str) -> str:
    """Return one line about an experiment of the registry, or about a file."""
    return _file.describe(word) if _file.is_file(word) else EXPERIMENTS[resolve(word)][1]


def names() -> list[str]:
    """List the experiments in the order of the registry."""
    return list(EXPERIMENTS)


def check(words: Sequence[str], *more: str) -> None:
    """Raise ValueError, before anything is imported, for words that name no experiment.

    Arguments:
        words: names of the registry, aliases, or paths of files (`*.py`).
        more: further words that have a meaning.
    """
    known = [*EXPERIMENTS, *ALIASES, *more]
    for word in words:
        if _file.is_file(word):
            others = (each for each in words if _file.is_file(each) and each != word)
            _file.check(word, [*known, *map(resolve, others)])
        elif word not in known:
            own = f"{word}.py"
            if Path(own).is_file():
                raise ValueError(f"no experiment {word!r}: did you mean the file {own!r}?")
            raise ValueError(unknown("experiment", word, known))


def load(word: str) -> ModuleType:
    """Import the module of an experiment: a name of the registry, or the path of a file (`*.py`).

    Raises: ValueError with the nearest name when there is no such experiment, or for a file that is
    none, and whatever the module itself raises.
    """
    if _file.is_file(word):
        _file.check(word, [*EXPERIMENTS, *ALIASES])
        return _file.load(word)
    if word not in EXPERIMENTS:
        raise ValueError(unknown("experiment", word, names()))
    return importlib.import_module(EXPERIMENTS[word][0])


def unknown(kind: str, word: str, words: Iterable[str]) -> str:
    """Say that a word is none of the known words, and which of them is nearest to it."""
    words = list(words)
    near = difflib.get_close_matches(word, words, n=1)
    advice = f"did you mean {near[0]!r}?" if near else f"choose from {', '.join(words)}"
    return f"no {kind} {word!r}: {advice}"
