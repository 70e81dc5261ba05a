"""How far ILQG's prediction holds: expected costs and end points against trials, over the noise.

Reaches of 10 cm in 8 directions by both arms, under motor noise of five intensities: what ILQG's
local model expects of its own policy, beside the mean of many noisy trials. The model is exact for
a linear plant; on an arm it leaves out how the dynamics curve, and that an excitation cannot fall
below zero, where the policy's controls are clipped. So the muscle arm has a second row, whose
trials are not clipped: what is missing there is the curvature alone. Intensities, directions and
weights are ours.
"""

from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import jaxctrl as jc

from . import _chapter_5 as shared
from ._result import Claim, Result, named

CASES = {
    "torque": "torque arm",
    "muscle": "muscle arm",
    "muscle, unclipped": "muscle arm, unclipped",
}
FACTORS = (0.25, 0.5, 1.0, 1.5, 2.5)
"""Motor noise in units of that of the other figures; 0.05 s^(1/2) is half of a control in 10 ms."""
LIMIT = 0.05
"""How far prediction and trials may be apart, relatively."""
SURE = 3.0
"""Standard errors by which they must be further apart to count as such."""


@dataclass(frozen=True)
class Config(shared.Reaches):
    """Settings of the reaches, where `motor_noise` is what the factors multiply; number of factors,
    trials of each movement, and seed."""

    factors: int = len(FACTORS)
    trials: int = 4000
    seed: int = 0

    @classmethod
    def quick(cls) -> "Config":
        """Return settings with one direction and few trials."""
        return cls(directions=1, factors=3, trials=400)


class Row(NamedTuple):
    """What one arm's policies promise and do, each (intensity, direction), and whether all did.

    Attributes:
        expected, cost, error: the cost that ILQG expects, that of the trials, its standard error.
        predicted, found: standard deviations of the end points [m].
    """

    expected: np.ndarray
    cost: np.ndarray
    error: np.ndarray
    predicted: np.ndarray
    found: np.ndarray


def run(config: Config) -> Result:
    """Plan at every intensity with both arms, and try out; arrays lead with case and intensity."""
    sigma = config.motor_noise * np.array(FACTORS[: config.factors])
    rows, failures = [], []
    for kind, arm in (("torque", jc.plants.TorqueArm()), ("muscle", jc.plants.MuscleArm())):
        problems, found = _plan(arm, sigma, config)
        if not bool(found.status.ok.all()):
            failures.append(f"{kind}: {found.status.message}")
        rows.append(_row(arm, problems, found, found.policy, config))
    free = eqx.tree_at(lambda policy: policy.bounds, found.policy, None)
    rows.append(_row(arm, problems, found, free, config))
    meanings = {
        "expected": named("cost expected by ILQG", "1"),
        "cost": named("mean cost of noisy trials", "1"),
        "error": named("standard error of the mean cost", "1"),
        "predicted": named("SD of the end points, predicted by ILQG", "m"),
        "found": named("SD of the end points of noisy trials", "m"),
    }
    dims = ("case", "intensity", "direction")
    data = xarray.Dataset(
        {
            name: (dims, np.stack([getattr(row, name) for row in rows]), attrs)
            for name, attrs in meanings.items()
        },
        coords={
            "case": ("case", list(CASES), {"long_name": "arm"}),
            "intensity": ("intensity", sigma, named("motor noise", "s^(1/2)")),
            "direction": config.coordinates()["direction"],
        },
    )
    return Result(data, config, "; ".join(failures))


def _plan(arm, sigma: np.ndarray, config: Config):
    """Return the problems and their solutions, both led by (intensity * direction)."""
    each = [config.problems(arm, motor_noise=float(intensity)) for intensity in sigma]
    problems = jax.tree.map(
        lambda *leaves: jnp.concatenate(leaves) if eqx.is_array(leaves[0]) else leaves[0], *each
    )
    return problems, jc.solve_batch(problems, jc.ILQG(), arm.at_rest(*shared.START))


def _row(arm, problems, found: jc.Solution, policies, config: Config) -> Row:
    """Try policies out. Trial i of a direction meets the same noise, scaled, at all intensities."""
    x0, n = arm.at_rest(*shared.START), config.directions
    keys = jax.random.split(jax.random.key(config.seed), n)
    keys = jnp.tile(keys, len(found.us) // n)
    outcome = jax.vmap(
        lambda problem, policy, key: jc.evaluate(problem, policy, x0, key=key, trials=config.trials)
    )(problems, policies, keys)
    assert found.prediction is not None
    predicted = shared.hand_cov(arm, found.xs[:, -1], found.prediction.x_cov[:, -1])
    hand_cov = jax.vmap(lambda e: e.hand_cov)(outcome)
    values = (
        found.expected_cost,
        jax.vmap(lambda e: e.cost)(outcome),
        jax.vmap(lambda e: e.cost_error)(outcome),
        shared.spread(predicted),
        shared.spread(np.asarray(hand_cov)),
    )
    return Row(*(np.asarray(value).reshape(-1, n) for value in values))


def _off(data: xarray.Dataset, trials: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return by how much trials exceed the prediction, and the standard error of that, relatively,
    each (case, intensity): of the costs, and of the deviations, over all directions."""
    cost, expected = data.cost.sum("direction"), data.expected.sum("direction")
    error = np.sqrt((data.error**2).sum("direction"))
    found = np.sqrt((data.found**2).mean("direction"))
    predicted = np.sqrt((data.predicted**2).mean("direction"))
    ratio = (found / predicted).values
    return {
        "cost": ((cost / expected - 1).values, (error / expected).values),
        "SD of the end points": (ratio - 1, ratio / np.sqrt(2 * trials * data.sizes["direction"])),
    }


def figure(result: Result) -> Figure:
    """Draw costs and deviations against the noise, and by how much trials exceed them."""
    data = result.data
    fig, axes = jc.plot.panels(2, 2, size=(7.2, 5.4))
    off = _off(data, result.config.trials)
    with jc.plot.style():
        _draw_cost(axes[0, 0], data)
        _draw_deviation(axes[0, 1], data)
        for ax, (name, (ratio, error)) in zip(axes[1], off.items(), strict=True):
            for i in range(len(CASES)):
                ax.errorbar(
                    data.intensity, 100 * ratio[i], 100 * SURE * error[i], color=f"C{i}",
                    marker="os^"[i], markersize=4, linewidth=1.0, capsize=2,
                )  # fmt: skip
            ax.axhspan(-100 * LIMIT, 100 * LIMIT, color="0.9", zorder=0)
            ax.set_yscale("symlog", linthresh=100 * LIMIT, linscale=1.5)
            ax.set_yticks([-5, 0, 5, 50, 500], ["−5", "0", "5", "50", "500"])
            ax.set_ylim(-8, 800)
            ax.set_ylabel(f"{name}:\ntrials above prediction [%]")
        for ax in axes.flat:
            ax.set_xscale("log")
            ax.set_xticks(data.intensity.values, [f"{s:g}" for s in data.intensity.values])
            ax.minorticks_off()
            ax.set_xlabel(r"motor noise [s$^{1/2}$]")
        fig.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return fig


def _draw_cost(ax: Axes, data: xarray.Dataset) -> None:
    """Draw mean costs over all directions, predicted and found."""
    for i, (case, name) in enumerate(CASES.items()):
        one = data.sel(case=case).mean("direction")
        if case != "muscle":  # the two rows of the muscle arm have one prediction
            label = f"{case.partition(',')[0]} arm, predicted"
            ax.plot(data.intensity, one.expected, color=f"C{i}", linestyle="--", label=label)
        ax.plot(
            data.intensity, one.cost, color=f"C{i}", marker="os^"[i], markersize=4,
            linestyle="", label=f"{name}, trials",
        )  # fmt: skip
    ax.set_yscale("log")
    ax.set_ylabel("cost [1]")


def _draw_deviation(ax: Axes, data: xarray.Dataset) -> None:
    """Draw the end points' standard deviations over all directions, predicted and found."""
    for i, case in enumerate(CASES):
        one = np.sqrt((data.sel(case=case)[["predicted", "found"]] ** 2).mean("direction"))
        if case != "muscle":
            ax.plot(data.intensity, 1e3 * one.predicted, color=f"C{i}", linestyle="--")
        ax.plot(
            data.intensity, 1e3 * one.found, color=f"C{i}", marker="os^"[i], markersize=4,
            linestyle="",
        )  # fmt: skip
    ax.set_yscale("log")
    ax.set_ylabel("SD of the end points [mm]")


def claims(result: Result) -> list[Claim]:
    """Judge, of each arm, up to which noise prediction and trials are within 5 %."""
    data = result.data
    off = _off(data, result.config.trials)
    return [_within(data, case, name, *values) for case in CASES for name, values in off.items()]


def _within(data: xarray.Dataset, case: str, name: str, ratio, error) -> Claim:
    """Judge one row and one number: whether no intensity is surely off by more than 5 %."""
    i = list(CASES).index(case)
    apart, unsure = np.abs(ratio[i]), SURE * error[i]
    beyond = apart - unsure > LIMIT
    sigma = data.intensity.values
    table = ", ".join(
        f"{100 * r:+.2g} +- {100 * e:.1g} % at {s:g}"
        for r, e, s in zip(ratio[i], error[i], sigma, strict=True)
    )
    left = f" It leaves 5 % at {sigma[np.argmax(beyond)]:g} s^(1/2)." if beyond.any() else ""
    return Claim(
        f"{name[0].upper()}{name[1:]} of the {CASES[case]} as ILQG predicts within 5 %",
        "this package",
        f"trials within {100 * LIMIT:g} % of the prediction at {sigma[0]:g}-{sigma[-1]:g} s^(1/2)",
        table,
        not beyond.any(),
        _WHY[case] + left if beyond.any() else "",
    )


_WHY = {
    "torque": "The model leaves out how the dynamics curve.",
    "muscle": "Excitations are clipped at zero, which the model does not know.",
    "muscle, unclipped": "The model leaves out how the dynamics curve.",
}
