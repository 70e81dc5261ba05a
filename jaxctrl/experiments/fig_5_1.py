"""Figure 5.1 of Li (2006): reaches of the torque-driven arm by ILQG, its state fully observed.

10 cm in 8 directions under motor noise of 0.02 s^(1/2), a fifth of each torque over 10 ms. Planned
is the average behaviour that the thesis draws. Beside it are the 95 % ellipses of the end points
that ILQG predicts by its local model, and what noisy trials give. Start, noise and weights are
ours.
"""

from dataclasses import dataclass

import jax
import numpy as np
import xarray
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import jaxctrl as jc

from . import _chapter_5 as shared
from ._result import Claim, Result, named

ENLARGED = 50
"""How many times too large the ellipses are drawn."""


@dataclass(frozen=True)
class Config(shared.Reaches):
    """Settings: those of the reaches, number of noisy trials of each direction, and seed."""

    trials: int = 1000
    seed: int = 0

    @classmethod
    def quick(cls) -> "Config":
        """Return settings with few trials."""
        return cls(trials=100)


def run(config: Config) -> Result:
    """Plan in every direction, and let the policies meet the noise; arrays lead with direction."""
    arm = jc.plants.TorqueArm()
    x0 = arm.at_rest(*shared.START)
    problems = config.problems(arm)
    found = jc.solve_batch(problems, jc.ILQG(), x0)
    keys = jax.random.split(jax.random.key(config.seed), config.directions)

    def evaluate(problem, policy, key):
        return jc.evaluate(problem, policy, x0, key=key, trials=config.trials)

    outcome = jax.vmap(evaluate)(problems, found.policy, keys)
    failure = "" if bool(found.status.ok.all()) else found.status.message
    return Result(_dataset(config, arm, found, outcome), config, failure)


def _dataset(config: Config, arm, found: jc.Solution, outcome: jc.Evaluation) -> xarray.Dataset:
    """Label what was planned and what came out of the noisy trials."""
    planar = ("direction", "axis", "other")
    prediction = found.prediction
    assert prediction is not None
    predicted = shared.hand_cov(arm, found.xs[:, -1], prediction.x_cov[:, -1])
    data = config.planned(arm, found) | {
        "torque": (("direction", "step", "joint"), found.us, named("planned joint torque", "N m")),
        "predicted_end_cov": (
            planar,
            predicted,
            named("predicted covariance of the end points", "m^2"),
        ),
        "end_cov": (
            planar,
            jax.vmap(lambda e: e.hand_cov)(outcome),
            named("covariance of the end points of noisy trials", "m^2"),
        ),
        "end": (
            ("direction", "trial", "axis"),
            outcome.hands,
            named("end points of noisy trials", "m"),
        ),
        "cost": ("direction", jax.vmap(lambda e: e.cost)(outcome), named("mean cost", "1")),
        "cost_error": (
            "direction",
            jax.vmap(lambda e: e.cost_error)(outcome),
            named("standard error of the mean cost", "1"),
        ),
        "expected_cost": ("direction", found.expected_cost, named("cost expected by ILQG", "1")),
    }
    coords = config.coordinates("step", "other")
    coords["joint"] = ("joint", ["shoulder", "elbow"], {"long_name": "joint"})
    return xarray.Dataset(data, coords=coords)


def figure(result: Result) -> Figure:
    """Draw paths, speeds and ellipses above torques and the deviations of the end points."""
    data = result.data
    labels = [f"{angle:.0f}°" for angle in data.direction.values]
    colours = jc.plot.direction_colours(np.radians(data.direction.values))
    fig, axes = jc.plot.panels(2, 3, size=(10.0, 6.0))
    for ax in axes[0]:
        ax.set_prop_cycle(color=colours)
    jc.plot.hand_paths(list(data.hand.values), data.target.values, labels=labels, ax=axes[0, 0])
    axes[0, 0].get_legend().remove()
    jc.plot.speed_profiles(data.time, list(data.speed.values), labels=labels, ax=axes[0, 1])
    _draw_ends(axes[0, 2], data)
    with jc.plot.style():
        for ax, joint in zip(axes[1, :2], data.joint.values, strict=True):
            for torque, colour in zip(data.torque.sel(joint=joint).values, colours, strict=True):
                ax.stairs(torque, data.time.values, baseline=None, linewidth=1.2, color=colour)
            ax.set_xlabel("time [s]")
            ax.set_ylabel(f"{joint} torque [N m]")
        _draw_deviations(axes[1, 2], data)
    low = min(ax.get_ylim()[0] for ax in axes[1, :2])
    high = max(ax.get_ylim()[1] for ax in axes[1, :2])
    for ax in axes[1, :2]:
        ax.set_ylim(low, high)
    return fig


def _draw_ends(ax: Axes, data: xarray.Dataset) -> None:
    """Draw end points and both ellipses around the mean end points, all enlarged alike."""
    centres = data.hand.values[:, -1]
    ends = [c + ENLARGED * (e - c) for c, e in zip(centres, data.end.values[:, :200], strict=True)]
    jc.plot.points(ends, ax=ax)
    for centre, predicted, found in zip(
        100 * centres, data.predicted_end_cov.values, data.end_cov.values, strict=True
    ):
        shared.draw_ellipse(ax, centre, predicted, ENLARGED, edgecolor="k")
        shared.draw_ellipse(ax, centre, found, ENLARGED, edgecolor="C1", linestyle="--")
    with jc.plot.style():
        lines = ax.plot([], [], "k", [], [], "C1--")
        ax.legend(
            lines, ["predicted", "noisy trials"], loc="center",
            title=f"95 % ellipses of\nthe end points,\n{ENLARGED}× too large",
        )  # fmt: skip


def _draw_deviations(ax: Axes, data: xarray.Dataset) -> None:
    """Draw predicted and found standard deviations of the end points."""
    turn = np.append(data.direction.values, 360.0)
    looks = {"predicted_end_cov": ("k", "-", "predicted"), "end_cov": ("C1", "--", "noisy trials")}
    for name, (colour, dash, label) in looks.items():
        sd = 1e3 * shared.spread(data[name].values)
        ax.plot(turn, np.append(sd, sd[0]), dash, marker="o", color=colour, label=label)
    shared.on_compass(ax)
    ax.set_ylim(bottom=0)
    ax.set_ylabel("SD of the end points [mm]")
    ax.legend(loc="lower right")


SOURCE = "Li (2006), fig. 5.1"


def claims(result: Result) -> list[Claim]:
    """Judge whether the movements end on their targets and have bell-shaped speeds."""
    data = result.data
    errors = shared.end_errors(data)
    means = np.linalg.norm(data.end.values.mean(axis=1) - data.target.values, axis=1)
    ratio = shared.spread(data.end_cov.values) / shared.spread(data.predicted_end_cov.values)
    return [
        Claim(
            "The hand ends on its target in all directions",
            SOURCE,
            "within 5 mm",
            f"largest error {1e3 * errors.max():.3f} mm planned, {1e3 * means.max():.2f} mm for "
            f"the mean of {data.sizes['trial']} noisy trials, whose SD is {ratio.min():.2f}-"
            f"{ratio.max():.2f} of the predicted one",
            bool((errors < shared.NEAR).all()),
        ),
        shared.bells(data, SOURCE),
    ]
