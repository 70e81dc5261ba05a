"""Figure 5.8 of Li (2006): what noise does to reaches without feedback, and with two kinds of it.

The six-muscle arm reaches 10 cm in 8 directions under motor noise of 0.05 s^(1/2), the thesis's
half of each control over 10 ms, in three ways: A the nominal controls of ILQG without feedback, B
ILQG, C the feedback that ILQR finds when it knows of no noise. Trial i of a direction meets the
same noise in all three (common random numbers), so that the intervals are those of differences
trial by trial. They are pointwise, mean +- 1.96 standard errors; costs have long tails to the
right. Covariances of the end points are reported and not judged: ILQG minimises the expected
cost, which is no variance. Beside them is what ILQG expects of B by its local model. The trials
cost and scatter more, the end points 1.5 to 6.4 times as much, because feedback cannot take an
excitation below zero: let it, and their SD is 0.96 to 1.11 of the expected one (1000 trials).
Number of directions, start and weights are ours.
"""

from dataclasses import dataclass

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

CONTROLLERS = {"A": "open loop", "B": "ILQG", "C": "ILQR, made without noise"}
PAIRS = (("A", "C"), ("C", "B"))
"""The first costs more than the second."""
INTERVAL = 1.96
"""Half width of a 95 % interval, in standard errors."""


@dataclass(frozen=True)
class Config(shared.Reaches):
    """Settings: those of the reaches, number of trials of each direction and way, how many of them
    are kept to be drawn, and seed."""

    motor_noise: float = 0.05
    trials: int = 4000
    drawn: int = 8
    seed: int = 0

    @classmethod
    def quick(cls) -> "Config":
        """Return settings with few trials."""
        return cls(trials=100, drawn=3)


def run(config: Config) -> Result:
    """Plan twice, then let all three controllers meet the noise; arrays lead with controller."""
    arm = jc.plants.MuscleArm()
    x0 = arm.at_rest(*shared.START)
    problems = config.problems(arm)
    found = {
        "ILQG": jc.solve_batch(problems, jc.ILQG(), x0),
        "ILQR": jc.solve_batch(config.problems(arm, motor_noise=None), jc.ILQR(), x0),
    }
    failed = [f"{k}: {s.status.message}" for k, s in found.items() if not bool(s.status.ok.all())]
    closed, ignorant = (solution.policy for solution in found.values())
    # Without gains, the policy is the nominal controls.
    blind = eqx.tree_at(lambda policy: policy.K, closed, jnp.zeros_like(closed.K))
    policies = jax.tree.map(lambda *leaves: jnp.stack(leaves), blind, closed, ignorant)
    keys = jax.random.split(jax.random.key(config.seed), config.directions)

    def evaluate(problem, policy, key):
        return jc.evaluate(problem, policy, x0, key=key, trials=config.trials)

    def some(problem, policy, key):
        def trial(i):
            drawn = jc.simulate(problem, policy, x0, key=jax.random.fold_in(key, i))
            return jax.vmap(arm.hand)(drawn.xs)

        return jax.vmap(trial)(jnp.arange(config.drawn))

    def everywhere(call):
        over_directions = jax.vmap(call)
        return jax.vmap(over_directions, in_axes=(None, 0, None))(problems, policies, keys)

    outcome, noisy = everywhere(evaluate), everywhere(some)
    return Result(_dataset(config, arm, found, outcome, noisy), config, "; ".join(failed))


def _dataset(config: Config, arm, found, outcome: jc.Evaluation, noisy) -> xarray.Dataset:
    names, both = list(CONTROLLERS), ("controller", "direction")
    by_name = {name: jax.tree.map(lambda a, i=i: a[i], outcome) for i, name in enumerate(names)}
    differ = jax.vmap(jc.Evaluation.difference)
    gaps = [differ(by_name[more], by_name[less]) for more, less in PAIRS]
    plan = found["ILQG"]
    on_grid = jax.vmap(jax.vmap(arm.hand))
    planned = np.stack([on_grid(found[k].xs) for k in ("ILQG", "ILQG", "ILQR")])
    hands = np.asarray(outcome.hands)
    centred = hands - hands.mean(axis=2, keepdims=True)
    cov = np.einsum("cdti,cdtj->cdij", centred, centred) / (config.trials - 1)
    predicted = shared.hand_cov(arm, plan.xs[:, -1], plan.prediction.x_cov[:, -1])
    pairs = ("pair", "direction")
    data = {
        "cost": (both, jax.vmap(jax.vmap(lambda e: e.cost))(outcome), named("mean cost", "1")),
        "cost_error": (
            both,
            jax.vmap(jax.vmap(lambda e: e.cost_error))(outcome),
            named("standard error of the mean cost", "1"),
        ),
        "expected_cost": (
            "direction",
            plan.expected_cost,
            named("cost that ILQG expects of B, by its local model", "1"),
        ),
        "difference": (
            pairs,
            np.stack([mean for mean, _ in gaps]),
            named("mean difference of costs, trial by trial", "1"),
        ),
        "difference_error": (
            pairs,
            np.stack([error for _, error in gaps]),
            named("standard error of the mean difference", "1"),
        ),
        "end_mean": ((*both, "axis"), hands.mean(axis=2), named("mean end point", "m")),
        "end_cov": ((*both, "axis", "other"), cov, named("covariance of the end points", "m^2")),
        "predicted_end_cov": (
            ("direction", "axis", "other"),
            predicted,
            named("covariance of B's end points by ILQG's local model", "m^2"),
        ),
        "planned": ((*both, "time", "axis"), planned, named("planned hand position", "m")),
        "noisy": (
            (*both, "trial", "time", "axis"),
            noisy,
            named("hand position in some noisy trials", "m"),
        ),
        "target": (("direction", "axis"), config.targets(arm), named("target", "m")),
    }
    coords = config.coordinates("other")
    coords["controller"] = ("controller", names, {"long_name": "controller"})
    coords["pair"] = ("pair", [f"{a} - {b}" for a, b in PAIRS], {"long_name": "difference"})
    return xarray.Dataset(data, coords=coords)


ENLARGED = {"A": 1, "B": 50, "C": 50}
"""How many times too large the ellipses are drawn."""


def figure(result: Result) -> Figure:
    """Draw trials and end ellipses of A, B and C above costs, their differences and deviations."""
    data, kept = result.data, f"mean of {result.data.sizes['trial']} trials"
    fig, axes = jc.plot.panels(2, 3, size=(10.0, 6.6))
    for ax, (name, word) in zip(axes[0], CONTROLLERS.items(), strict=True):
        _draw_trials(ax, data.sel(controller=name), ENLARGED[name])
        with jc.plot.style():
            times = "" if ENLARGED[name] == 1 else f" ×{ENLARGED[name]}"
            ax.set_title(f"{name}  {word}\n{kept}; 95 % ellipses{times}", loc="left")
    low = np.min([(ax.get_xlim()[0], ax.get_ylim()[0]) for ax in axes[0]], axis=0)
    high = np.max([(ax.get_xlim()[1], ax.get_ylim()[1]) for ax in axes[0]], axis=0)
    for ax in axes[0]:
        ax.set_xlim(low[0], high[0])
        ax.set_ylim(low[1], high[1])
    with jc.plot.style():
        _draw_costs(axes[1, 0], data)
        _draw_differences(axes[1, 1], data)
        _draw_deviations(axes[1, 2], data)
        for ax in axes[1]:
            shared.on_compass(ax)
            ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=2)
    return fig


def _draw_trials(ax: Axes, one: xarray.Dataset, enlarged: int) -> None:
    """Draw the noisy trials of one controller, and the ellipses of their ends."""
    shared.colour_directions(ax, one)
    jc.plot.hand_paths(list(one.noisy.values), one.target.values, ax=ax)
    legend = ax.get_legend()
    assert legend is not None
    legend.remove()
    colours = jc.plot.direction_colours(np.radians(one.direction.values))
    for centre, cov, colour in zip(one.end_mean.values, one.end_cov.values, colours, strict=True):
        shared.draw_ellipse(ax, 100 * centre, cov, enlarged, edgecolor=colour)


def _around(values) -> np.ndarray:
    """Repeat the first direction at 360 degrees."""
    return np.append(values, values[:1])


def _draw_costs(ax: Axes, data: xarray.Dataset) -> None:
    """Draw mean costs and their intervals."""
    turn = np.append(data.direction.values, 360.0)
    for i, name in enumerate(CONTROLLERS):
        one = data.sel(controller=name)
        error = INTERVAL * _around(one.cost_error.values)
        look = {"color": f"C{i}", "marker": "os^"[i], "capsize": 2, "linewidth": 1.0}
        ax.errorbar(turn, _around(one.cost.values), error, markersize=4, label=name, **look)
    expected = _around(data.expected_cost.values)
    ax.plot(turn, expected, "--", color="C1", label="B, by ILQG's model")
    ax.set_yscale("log", nonpositive="clip")
    ax.set_ylabel("cost [1], mean and 95 % interval")


def _draw_differences(ax: Axes, data: xarray.Dataset) -> None:
    """Draw the differences trial by trial, with their intervals, in units of B's cost."""
    turn = np.append(data.direction.values, 360.0)
    unit = data.cost.sel(controller="B").values
    low, high = -0.5, 1.0
    for i, pair in enumerate(data.pair.values):
        one = data.sel(pair=pair)
        mean, error = one.difference.values / unit, INTERVAL * one.difference_error.values / unit
        look = {"color": ("k", "C2")[i], "marker": "s^"[i], "capsize": 2, "linewidth": 1.0}
        label = str(pair).replace("-", "−")
        ax.errorbar(turn, _around(mean), _around(error), markersize=4, label=label, **look)
        low, high = min(low, 1.5 * (mean - error).min()), max(high, 2.5 * (mean + error).max())
    ax.axhline(0.0, color="0.5", linewidth=0.8)
    ax.set_yscale("symlog", linthresh=1.0)
    ax.set_ylim(low, high)
    ax.set_ylabel("difference of costs / cost of B [1]")


def _draw_deviations(ax: Axes, data: xarray.Dataset) -> None:
    """Draw the standard deviations of the end points."""
    turn = np.append(data.direction.values, 360.0)
    for i, name in enumerate(CONTROLLERS):
        found = 1e3 * shared.spread(data.end_cov.sel(controller=name).values)
        ax.plot(turn, _around(found), color=f"C{i}", marker="os^"[i], markersize=4, label=name)
    predicted = 1e3 * shared.spread(data.predicted_end_cov.values)
    ax.plot(turn, _around(predicted), "--", color="C1", label="B, by ILQG's model")
    ax.set_yscale("log")
    ax.set_ylabel("SD of the end points [mm]")


SOURCE = "Li (2006), fig. 5.8"


def claims(result: Result) -> list[Claim]:
    """Judge whether A costs more than C and C more than B, in all and in each direction."""
    return [claim for pair in PAIRS for claim in _more(result, *pair)]


def _more(result: Result, more: str, less: str) -> list[Claim]:
    """Judge whether one way costs more than another, by intervals of paired differences."""
    data = result.data
    one = data.sel(pair=f"{more} - {less}")
    mean, error = one.difference.values, one.difference_error.values
    overall = mean.mean(), np.sqrt((error**2).sum()) / mean.size
    costs = {name: float(data.cost.sel(controller=name).mean()) for name in (more, less)}
    clear = mean > INTERVAL * error
    against = mean < -INTERVAL * error
    weakest = int(np.argmin(mean / error))
    sds = ", ".join(
        f"{name} {1e3 * shared.spread(data.end_cov.sel(controller=name).values).mean():.3g} mm"
        for name in (more, less)
    )
    words = f"{CONTROLLERS[more]} ({more})", f"{CONTROLLERS[less]} ({less})"
    return [
        Claim(
            f"{words[0]} costs more than {words[1]}, over all directions",
            SOURCE,
            f"E[J]: {more} > {less}, the 95 % interval of the difference above 0",
            f"{costs[more]:.3g} and {costs[less]:.3g}; difference {overall[0]:.3g} +- "
            f"{INTERVAL * overall[1]:.2g}; SD of the end points {sds}",
            overall[0] > INTERVAL * overall[1],
            _why(result, overall[0] > INTERVAL * overall[1], overall[0] < -INTERVAL * overall[1]),
        ),
        Claim(
            f"{words[0]} costs more than {words[1]}, in each direction",
            SOURCE,
            "the 95 % interval of the difference above 0 in every direction",
            f"above 0 in {clear.sum()}, below 0 in {against.sum()} of {mean.size} directions; "
            f"nearest at {one.direction.values[weakest]:.0f} degrees: {mean[weakest]:.2g} +- "
            f"{INTERVAL * error[weakest]:.2g}",
            clear.all(),
            _why(result, clear.all(), against.any()),
        ),
    ]


def _why(result: Result, holds: bool, against: bool) -> str:
    """Say why an ordering does not hold: the other way round, or too few trials to tell."""
    if holds:
        return ""
    if against:
        return "the order is the other way round, beyond what chance explains"
    return (
        f"{result.config.trials} trials of each direction are too few to tell: the costs of either "
        "way have long tails"
    )
