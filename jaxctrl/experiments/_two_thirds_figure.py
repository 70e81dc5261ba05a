"""The estimates and the figure of the experiment on the two-thirds power law."""

import numpy as np
import xarray
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import jaxctrl as jc

from . import _closed_paths as shapes
from ._result import Result
from ._shape_prediction import predicted_exponent

MODELS = ("torque", "muscle", "jerk")
FAMILIES = ("ellipse", "scribble")
TITLES = {"torque": "torque arm", "muscle": "muscle arm", "jerk": "minimum jerk"}
SHORT = {"torque": "torques", "muscle": "muscles", "jerk": "least jerk"}


def law_of(
    hand: np.ndarray, velocity: np.ndarray, ts: np.ndarray, trim: float
) -> jc.analysis.PowerLaw:
    """Fit one law to one record (N, 2), or to several (n, N, 2) with a gain for each."""
    kappa = jc.analysis.curvature(hand, ts, velocities=velocity)
    return jc.analysis.power_law(np.linalg.norm(velocity, axis=-1), kappa, trim=trim)


def pooled(result: Result, model: str, family: str) -> jc.analysis.PowerLaw:
    """Fit one exponent to all ellipses or all scribbles of a model."""
    names = [name for name in result.data.curve.values if name.startswith(family)]
    data = result.data.sel(model=model, curve=names)
    return law_of(data.hand.values, data.velocity.values, data.time.values, result.config.trim)


def predictions(result: Result) -> np.ndarray:
    """Return what theory predicts of least jerk on each scribble, NaN where it predicts nothing.

    The predicted speed is sampled where the movement was, and goes through the same estimator.
    """
    config = result.config
    names, waves = shapes.scribbles(config.scribbles, config.harmonics, config.tightest)
    phases = result.data.phase.sel(model="jerk", curve=names).values
    pairs = zip(waves, phases, strict=True)
    return np.array([predicted_exponent(wave, phase, config.trim) for wave, phase in pairs])


def figure(result: Result) -> Figure:
    """Draw speed against radius for each model, hand paths, and all exponents."""
    data = result.data
    shown = [
        next(name for name in data.curve.values if name.startswith(family)) for family in FAMILIES
    ]
    fig, axes = jc.plot.panels(2, 3, size=(10.0, 6.0))
    for ax, model, letter in zip(axes[0], MODELS, "ABC", strict=True):
        _scatter(ax, data.sel(model=model), shown, result.config.trim)
        _title(ax, f"{letter}  {TITLES[model]}")
    for ax, name, letter in zip(axes[1], shown, "DE", strict=False):
        _paths(ax, data.sel(curve=name))
        _title(ax, f"{letter}  {name}")
    _summary(axes[1, 2], result)
    _title(axes[1, 2], "F  exponents")
    return fig


def _title(ax: Axes, text: str) -> None:
    with jc.plot.style():
        ax.set_title(text, loc="left")


def _paths(ax: Axes, data: xarray.Dataset) -> None:
    """Draw what the muscle arm's hand makes of a given path."""
    jc.plot.hand_paths(data.hand.sel(model="muscle").values, ax=ax)
    with jc.plot.style():
        ax.lines[0].set(label="hand, muscle arm", linewidth=3, alpha=0.5)
        ax.plot(*(100 * data.path.values.T), color="k", lw=0.8, ls="--", label="given")
        if data.curve.item().startswith("ellipse"):  # which leaves room in the middle
            ax.legend(loc="center")
        elif legend := ax.get_legend():
            legend.remove()


def _scatter(ax: Axes, data: xarray.Dataset, names: list[str], trim: float) -> None:
    """Draw the samples that the estimator used, of an ellipse and of a scribble, with its fit."""
    cut = int(trim * data.time.size)
    inside = slice(cut, data.time.size - cut)
    radii, speeds, laws = [], [], []
    for name in names:
        hand, velocity = data.hand.sel(curve=name).values, data.velocity.sel(curve=name).values
        laws.append(law_of(hand, velocity, data.time.values, trim))
        kappa = np.abs(jc.analysis.curvature(hand, data.time.values, velocities=velocity))[inside]
        radii.append(np.where(kappa > 1, 1 / kappa, np.nan))
        speeds.append(np.linalg.norm(velocity, axis=-1)[inside])
    jc.plot.power_law(
        radii,
        speeds,
        exponent=[law.exponent for law in laws],
        gain=[law.gain for law in laws],
        labels=[name.split()[0] for name in names],
        ax=ax,
    )
    with jc.plot.style():
        low, high = ax.get_ylim()
        ax.set_ylim(low, high * (high / low) ** 0.55)  # room for the legend
        ax.set_yticks([tick for tick in (0.05, 0.1, 0.2, 0.5, 1.0) if low <= tick <= high])
        ax.legend(loc="upper left", bbox_to_anchor=(0.03, 1.0), fontsize="small")


def _summary(ax: Axes, result: Result) -> None:
    """Draw each group's exponent with its interval, single paths, and the controls."""
    data, rows = result.data, []
    with jc.plot.style():
        for family in FAMILIES:
            names = [name for name in data.curve.values if name.startswith(family)]
            for model in MODELS:
                law, y = pooled(result, model, family), len(rows)
                single = data.exponent.sel(model=model, curve=names).values
                ax.plot(single, np.full(single.shape, y), "o", color="0.7", ms=3, mew=0)
                ax.plot(law.interval, (y, y), color="C0", lw=1.5)
                ax.plot(law.exponent, y, "o", color="C0", ms=5)
                rows.append(f"{family}s, {SHORT[model]}")
            if family == "scribble" and np.isfinite(theory := predictions(result)).any():
                ax.plot(theory, np.full(theory.shape, len(rows)), "D", color="C2", mfc="none", ms=4)
                rows.append("predicted (no inflection)")
            y, uniform = len(rows), data.uniform.sel(curve=names).values
            ax.plot(uniform, np.full(uniform.shape, y), "o", color="0.7", ms=3, mew=0)
            ax.plot(uniform.mean(), y, "s", color="C1", ms=4)
            rows.append(f"{family}s, uniform")
        tight, y = data.reference.values[-1], len(rows)
        ax.plot(tight, np.full(tight.shape, y), "o", color="0.7", ms=3, mew=0)
        ax.plot(tight.mean(), y, "s", color="C1", ms=4)
        rows.append("constant speed")
        mean, sd = data.null.values.mean(), data.null.values.std(ddof=1)
        ax.axvspan(mean - sd, mean + sd, color="0.9", zorder=0, label="noise, mean and SD")
        ax.axvline(1 / 3, color="C3", lw=1, label="two-thirds law, 1/3")
        ax.set_yticks(range(len(rows)), rows)
        ax.invert_yaxis()
        ax.set_xlabel("exponent of the radius of curvature")
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=2)
