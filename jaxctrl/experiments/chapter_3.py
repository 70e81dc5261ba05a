"""Chapter 3 of Li (2006) under several active states of the muscles: which findings hang on them.

The thesis's muscles are those of Brown, Cheng & Loeb (1999), whose force grows with a power of the
activation, 2.5 to 3.8 for the short ones of its arm. Its figures look like those of a muscle whose
force is proportional to the activation. Here every experiment of chapter 3 is run with each of
these active states, and each of its claims is judged for each.
"""

import dataclasses
import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray
from matplotlib.figure import Figure

import jaxctrl as jc

from ._planned import check_active_state
from ._result import Claim, Result, named

MODULES = {
    name: name.replace("-", "_").replace(".", "_")
    for name in (
        "fig-3.4", "fig-3.6", "fig-3.8", "fig-3.10", "centre-out", "curvature-map", "two-thirds",
    )
}  # fmt: skip


@dataclass(frozen=True)
class Config:
    """Settings: experiments and active states, each separated by semicolons, the default state
    first; and whether the experiments run with their `coarse`, quick, settings."""

    experiments: str = "; ".join(MODULES)
    active_states: str = "linear; brown"
    coarse: bool = False

    @classmethod
    def quick(cls) -> "Config":
        """Return settings for one experiment, coarse."""
        return cls("centre-out", coarse=True)

    def __post_init__(self):
        unknown = [name for name in _split(self.experiments) if name not in MODULES]
        if unknown or not _split(self.experiments):
            raise ValueError(
                f"experiments: some of {'; '.join(MODULES)} are wanted, got {self.experiments!r}"
            )
        if not _split(self.active_states):
            raise ValueError("active_states: at least one is wanted")
        for name in ("experiments", "active_states"):
            words = _split(getattr(self, name))
            if len(set(words)) < len(words):
                raise ValueError(f"{name}: each once is wanted, got {getattr(self, name)!r}")
        for state in _split(self.active_states):
            check_active_state(state)


def _split(words: str) -> list[str]:
    return [word.strip() for word in words.split(";") if word.strip()]


def run(config: Config) -> Result:
    """Run every experiment with every active state, and keep what its claims come to."""
    curves, failed = _split(config.active_states), []
    judged: dict[str, list[list[Claim]]] = {}
    for name in _split(config.experiments):
        module: Any = importlib.import_module(f".{MODULES[name]}", __package__)
        plain = module.Config.quick() if config.coarse else module.Config()
        results = [module.run(dataclasses.replace(plain, active_state=curve)) for curve in curves]
        failed += [
            f"{name}, {curve}: {result.failure}"
            for curve, result in zip(curves, results, strict=True)
            if result.failure
        ]
        judged[name] = [module.claims(result) for result in results]
    return Result(_dataset(judged, curves), config, "; ".join(failed))


def _dataset(judged: dict[str, list[list[Claim]]], curves: list[str]) -> xarray.Dataset:
    """Label the claims; texts and verdicts lead with the claim, then the active state."""
    rows = [(name, claims) for name, lists in judged.items() for claims in zip(*lists, strict=True)]

    def text(field: str, long_name: str):
        values = np.array([getattr(claims[0], field) for _, claims in rows])
        return "claim", values, {"long_name": long_name}

    def each(field: str, attributes: dict[str, str]):
        values = np.array([[getattr(claim, field) for claim in claims] for _, claims in rows])
        return ("claim", "curve"), values, attributes

    return xarray.Dataset(
        {
            "experiment": ("claim", np.array([name for name, _ in rows]), {"long_name": "name"}),
            "statement": text("statement", "what is claimed"),
            "source": text("source", "where it is claimed"),
            "expected": text("expected", "published value"),
            "measured": each("measured", {"long_name": "value found here"}),
            "note": each("note", {"long_name": "note"}),
            "holds": each("holds", named("whether the claim holds", "1")),
        },
        coords={"curve": ("curve", curves, {"long_name": "active state of the muscles"})},
    )


def figure(result: Result) -> Figure:
    """Draw how many claims of each experiment hold, one bar for each active state."""
    data = result.data
    names = list(dict.fromkeys(data.experiment.values.tolist()))
    fig, axes = jc.plot.panels(1, 1, size=(6.0, 1.4 + 0.5 * len(names)))
    ax, width = axes[0, 0], 0.8 / data.sizes["curve"]
    with jc.plot.style():
        for i, curve in enumerate(data.curve.values):
            part = data.sel(curve=curve)
            for k, name in enumerate(names):
                of = part.holds.values[part.experiment.values == name].astype(bool)
                at = k + (i + 0.5) * width - 0.4
                ax.barh(at, of.size, width, color="0.92", edgecolor="0.7", linewidth=0.5)
                label = str(curve) if k == 0 else None
                ax.barh(at, of.sum(), width, color=f"C{i}", label=label)
        ax.set_yticks(range(len(names)), names)
        ax.invert_yaxis()
        ax.set_ylabel("experiment")
        ax.set_xlabel("claims that hold, of those in the frame")
        fig.legend(title="active state", loc="outside upper right", ncols=data.sizes["curve"])
    return fig


def claims(result: Result) -> list[Claim]:
    """Return every claim once, judged by the first active state, with what it comes to in each."""
    found = []
    for i in range(result.data.sizes["claim"]):
        row = result.data.isel(claim=i)
        verdicts = [
            f"{curve}: {'YES' if holds else 'NO'}, {measured}"
            for curve, holds, measured in zip(
                row.curve.values, row.holds.values, row.measured.values, strict=True
            )
        ]
        found.append(
            Claim(
                f"{row.experiment.item()}: {row.statement.item()}",
                row.source.item(),
                row.expected.item(),
                " / ".join(verdicts),
                row.holds.values[0],
                str(row.note.values[0]),
            )
        )
    return found
