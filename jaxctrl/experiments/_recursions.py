"""ILQG with the fixed or the true Hessian of each step in its recursion (Li 2006, 5.1, point 3).

Where the Hessian H = Q_uu of a step is not positive definite, or a step has failed, the law is that
of a fixed one, by Levenberg and Marquardt's damping d:

    du = k + K dx = -H~^-1 (Q_u + Q_ux dx),    H~ = H + d.

Riccati's equation takes it for the minimiser, as `jc.ILQG` does, whose model has the price d:
V_xx <- Q_xx - Q_ux' H~^-1 Q_ux. The thesis's recursion holds for any law, with the true H:
V_xx <- Q_xx + K'Q_ux + Q_ux'K + K'H K.
"""

from itertools import product
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.axes import Axes

import jaxctrl as jc

from . import _chapter_5 as shared, _random_laws as random_laws
from ._result import Claim, named

DAMPINGS = (0.0, 0.1)
"""Damping at the start, relative to the curvature."""
LAWS = (0.3, 1.0)
"""Amplitudes of the laws from which ILQG starts [N m]."""
INTERVAL = 1.96
"""Half width of a 95 % interval, in standard errors."""
MARGIN = 0.05
"""Which part of the laws counts as few; our choice."""
SOURCE = "Li (2006), section 5.1, point 3"


class TrueHessianILQG(jc.AbstractShooting):
    """`ILQG` whose recursion has the true Hessian of each step; for problems without bounds.

    All else is that of `ILQG`: model, expected cost, line search, and when damping rises and falls.
    """

    second_order: ClassVar[bool] = False
    stochastic: ClassVar[bool] = True
    fixed: jc.ILQG = jc.ILQG()
    gradient_tolerance: float | None = eqx.field(static=True, default=None)
    cost_tolerance: float | None = eqx.field(static=True, default=None)
    step_tolerance: float | None = eqx.field(static=True, default=None)

    def expand(self, problem, xs, us, near):
        """Return the first-order model with the noise."""
        return self.fixed.expand(problem, xs, us, near)

    def law(self, model, damping, box, guess, last):
        """Return the law of one sweep, which holds nothing at bounds.

        Each step is a model of one step: the damped one gives the law, the true one its value.
        """

        def back(ahead, inputs):
            stage, damping = jax.tree.map(lambda leaf: leaf[None], inputs)
            one = jc.LocalModel(*stage[:-1], vx=ahead.vx, vxx=ahead.vxx, noise=stage.noise)
            chosen = jc.linear.lqr(one, damping)
            before = jc.linear.evaluate(one, chosen.k, chosen.K)
            finite = jnp.isfinite(jnp.sum(before.vx) + jnp.trace(before.vxx))
            return before, (chosen.k[0], chosen.K[0], chosen.curvature[0], chosen.ok, finite)

        end = jc.linear.Value(jnp.zeros((), model.vx.dtype), model.vx, model.vxx)
        kept = jax.lax.scan(back, end, (model.stages, damping), reverse=True)[1]
        k, K, curvature, ok, finite = kept

        def cost(du):
            """The expected cost of mean controls du (T, nu) under the gains."""

            def forth(dx, step):
                fx, fu, K, du = step
                return fx @ dx + fu @ du, du - K @ dx

            _, apart = jax.lax.scan(forth, jnp.zeros_like(model.vx), (model.fx, model.fu, K, du))
            return jc.linear.evaluate(model, apart, K).v

        still, law, back_to = (jc.linear.evaluate(model, a * k, K).v for a in (0.0, 1.0, -1.0))
        last = lambda flags: jnp.max(jnp.where(flags, jnp.arange(flags.size), -1))  # noqa: E731
        sweep = jc.linear.Sweep(
            k, K, jax.grad(cost)(jnp.zeros_like(k)), curvature,
            linear=(law - back_to) / 2, quadratic=(law + back_to) / 2 - still,
            ok=ok.all(), failed=last(~ok).astype(jnp.int32),
            nonfinite=last(~finite).astype(jnp.int32), settled=jnp.array(True),
        )  # fmt: skip
        return sweep, jnp.zeros_like(k)

    def merit(self, problem, xs, us, law, model=None):
        """Return the expected cost, shape ()."""
        return self.fixed.merit(problem, xs, us, law, model)


HESSIANS: dict[str, jc.AbstractShooting] = {"fixed": jc.ILQG(), "true": TrueHessianILQG()}


@eqx.filter_jit
def _solve(solver: jc.AbstractShooting, problems, x0, uss, first, limit: int):
    """Iterate on each problem from its controls uss (n, T, nu), damped by `first` at the start.

    Returns: expected costs, whether converged, and iterations, each (n,).
    """

    def each(lane):
        problem, us = lane

        def unfinished(carry):
            return solver.status(carry[0]).is_(jc.Reason.RUNNING) & (carry[1] <= limit)

        def body(carry):
            return solver.step(problem, carry[0], jnp.array(False)), carry[1] + 1

        start = eqx.tree_at(lambda state: state.lam, solver.init(problem, x0, us), first)
        state, count = jax.lax.while_loop(unfinished, body, (start, jnp.array(0)))
        return solver.record(state).cost, solver.status(state).ok, count - 1

    return jax.lax.map(each, (problems, uss))


def run(arm: jc.plants.TorqueArm, config: random_laws.Settings) -> dict[str, Any]:
    """Plan from random laws with each Hessian, undamped at first, and damped.

    Returns: the variables iterations, converged and expected.
    """
    x0, problems = arm.at_rest(*shared.START), config.problems(arm)
    one = jax.tree.map(lambda leaf: leaf[0], problems)
    drawn = [random_laws.draw(arm, one, amplitude, config) for amplitude in LAWS]
    tasks, laws = random_laws.all_pairs(
        problems, jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *drawn)
    )
    uss = eqx.filter_vmap(lambda law: jc.simulate(one, law, x0).us)(laws)
    cost, ok, count = zip(
        *(
            _solve(solver, tasks, x0, uss, jnp.array(first), config.max_steps)
            for solver, first in product(HESSIANS.values(), DAMPINGS)
        ),
        strict=True,
    )
    lanes = ("hessian", "damping", "direction", "amplitude", "law")
    shape = (len(HESSIANS), len(DAMPINGS), config.directions, len(LAWS), config.laws)

    def each(values, *names: str):
        return lanes, np.stack(values).reshape(shape), named(*names)

    return {
        "iterations": each(count, "iterations from a random law", "1"),
        "converged": each(ok, "whether the solver converged", "1"),
        "expected": each(cost, "expected cost", "1"),
    }


def coordinates() -> dict[str, Any]:
    """Return the coordinates hessian, damping and amplitude."""
    return {
        "hessian": ("hessian", list(HESSIANS), {"long_name": "the recursion's Hessian"}),
        "damping": ("damping", list(DAMPINGS), named("damping at the start", "1")),
        "amplitude": ("amplitude", list(LAWS), named("amplitude of the laws' torques", "N m")),
    }


def _near(data: xarray.Dataset) -> np.ndarray:
    """Return which lanes of point 3 converged to the best expected cost of their direction; the
    axes are hessian, damping, direction, amplitude and law."""
    cost = np.where(data.converged.values.astype(bool), data.expected.values, np.inf)
    return cost <= cost.min(axis=(0, 1, 3, 4), keepdims=True) * (1 + random_laws.NEAR)


def _compare(data: xarray.Dataset, damping: int, amplitude: int):
    """Compare the true Hessian with the fixed one, law by law, since one law's lanes are alike.

    Returns: mean and half width of a 95 % interval of the logarithm of the ratio of iterations,
    where both find the best, and of the difference of the fractions that do; and these fractions.
    """
    near = _near(data)[:, damping, :, amplitude].astype(float)
    counts = data.iterations.values[:, damping, :, amplitude]
    fixed, true = range(len(HESSIANS))
    both = near.min(axis=0)
    used = both.any(axis=0)
    logs = (both * np.log(counts[true] / counts[fixed])).sum(axis=0)
    ratios = logs[used] / both.sum(axis=0)[used]
    return (
        _interval(ratios),
        _interval((near[true] - near[fixed]).mean(axis=0)),
        near.mean(axis=(1, 2)),
    )


def _interval(values: np.ndarray) -> tuple[float, float]:
    """Return the mean of values (n,) and the half width of its 95 % interval."""
    return float(values.mean()), float(INTERVAL * values.std(ddof=1) / np.sqrt(values.size))


def draw(ax: Axes, data: xarray.Dataset) -> None:
    """Draw the ratio of iterations for each damping and amplitude, with its interval."""
    for i, damping in enumerate(DAMPINGS):
        found = np.array([_compare(data, i, j)[0] for j in range(len(LAWS))])
        ratio = np.exp(found[:, 0])
        ends = np.exp([found[:, 0] - found[:, 1], found[:, 0] + found[:, 1]])
        ax.errorbar(
            np.arange(len(LAWS)) + 0.1 * (i - 0.5), ratio, np.abs(ends - ratio), fmt="os"[i],
            color=f"C{i}", markersize=5, capsize=3, label=f"damping {damping:g} at the start",
        )  # fmt: skip
    ax.axhline(1.0, color="0.5", linewidth=0.8)
    ax.set_xticks(range(len(LAWS)), [f"{each:g}" for each in LAWS])
    ax.set_xlim(-0.5, len(LAWS) - 0.5)
    ax.set_title("D  true against fixed Hessian", loc="left")
    ax.set_xlabel("amplitude of the laws at the start [N m]")
    ax.set_ylabel("ratio of iterations, 95 %")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=2)


def claims(data: xarray.Dataset) -> list[Claim]:
    """Compare the iterations and the ends of both recursions."""
    found = {
        f"damping {damping:g}, laws of {amplitude:g} N m": _compare(data, i, j)
        for (i, damping), (j, amplitude) in product(enumerate(DAMPINGS), enumerate(LAWS))
    }
    ratios = "; ".join(
        f"{name}: {np.exp(mean):.3f} ({np.exp(mean - half):.3f} to {np.exp(mean + half):.3f})"
        for name, ((mean, half), _, _) in found.items()
    )
    parts = "; ".join(
        f"{name}: {true:.3f} and {fixed:.3f}" for name, (_, _, (fixed, true)) in found.items()
    )
    (mean, half), (less, width), _ = _compare(data, 1, 0)
    (undamped, around), _, _ = _compare(data, 0, 0)
    return [
        Claim(
            "Damped from the start, ILQG takes fewer iterations with the true Hessian in its "
            "recursion",
            SOURCE,
            f"the ratio to the fixed one's below 1 at 95 %, laws of {LAWS[0]:g} N m",
            ratios,
            mean + half < 0,
            "" if mean + half < 0 else "It does not, or the laws are too few to tell.",
        ),
        Claim(
            "Undamped at first, ILQG takes fewer iterations with the true Hessian in its recursion",
            SOURCE,
            f"the ratio to the fixed one's below 1 at 95 %, laws of {LAWS[0]:g} N m",
            f"{np.exp(undamped):.3f} ({np.exp(undamped - around):.3f} to "
            f"{np.exp(undamped + around):.3f})",
            undamped + around < 0,
            ""
            if undamped + around < 0
            else "A damping that rises only where a step fails is seldom there, and without it "
            "both recursions are the same.",
        ),
        Claim(
            "With the true Hessian as many laws lead to the best expected cost",
            SOURCE,
            f"damped from the start, laws of {LAWS[0]:g} N m: by less than "
            f"{100 * MARGIN:g} % of the laws fewer, at 95 %",
            f"{less:+.3f} +- {width:.2g}; true and fixed, {parts}",
            less - width > -MARGIN,
            "" if less - width > -MARGIN else "It loses some, or the laws are too few to tell.",
        ),
    ]
