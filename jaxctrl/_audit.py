"""Check a solution against a problem along its own states, and when it is run again."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._checks import is_concrete
from ._jit import jit
from ._problem import Problem
from ._simulate import simulate
from ._solution import Solution
from ._types import promote

COARSE = 0.1
"""The error of integrating a step, over the range of the state, that is named as a reason."""


class Audit(eqx.Module):
    """What a solution costs, along its own states and run again; printed, a table with reasons.

    Attributes:
        reported: the solution's nominal cost.
        cost: the problem's cost of its states and controls, as they are.
        policy_cost: that of its policy, run from its first state, whose last digit is changed.
        rollout_cost: that of its controls alone, run so, their last digits changed too.
        policy_drift, drift: how far the states of these two runs are from the solution's own, over
            the range of each state.
        excess: how far the controls are outside the problem's bounds, over the largest control.
        defects: how far each step of the plant leads past the next state, max_i |x_i - f_i| over
            the range max_k |x_i| of that state, shape (T,).
        integration: how far each step, cut into four, would lead elsewhere, over the range of each
            state, shape (T,); 0 for a discrete plant.
        growth: the standard deviation that the state gathers in open loop, over its range, when
            each step adds one of 1: what rounding errors are multiplied by.

    Under vmap all have a leading batch axis.
    """

    reported: Float[Array, ""]
    cost: Float[Array, ""]
    policy_cost: Float[Array, ""]
    rollout_cost: Float[Array, ""]
    policy_drift: Float[Array, ""]
    drift: Float[Array, ""]
    excess: Float[Array, ""]
    defects: Float[Array, " T"]
    integration: Float[Array, " T"]
    growth: Float[Array, ""]

    @property
    def sound(self) -> Array:
        """Whether the states are a trajectory of the plant and cost what was reported.

        Costs agree to sqrt(eps), relatively, defects are below eps^(3/4) of a state's range, and
        the controls are within the problem's bounds; shape () or the batch's.
        """
        defect = jnp.maximum(self.defects.max(-1), self.excess)
        return (defect <= _eps(defect) ** 0.75) & _agree(self.cost, self.reported)

    @property
    def reproducible(self) -> Array:
        """Whether it is sound and its controls alone lead the same way; shape () or the batch's.

        That is, they cost the same, or lead to the same states, both to sqrt(eps), relatively.
        """
        same = self.drift <= _eps(self.drift) ** 0.5
        return self.sound & (_agree(self.cost, self.rollout_cost) | same)

    @property
    def controlled(self) -> Array:
        """Whether it is sound and its policy, run again, leads the same way; shape () or batch."""
        same = self.policy_drift <= _eps(self.drift) ** 0.5
        return self.sound & (_agree(self.cost, self.policy_cost) | same)

    def __str__(self) -> str:
        if not is_concrete(self.cost) or self.cost.ndim:
            return eqx.tree_pformat(self)
        defects = np.asarray(self.defects)
        rows = [
            ("cost as reported", f"{self.reported:.9g}"),
            ("cost along its own states", f"{self.cost:.9g}"),
            ("cost of its policy, last digits changed", f"{self.policy_cost:.9g}"),
            ("cost of its controls alone, so changed", f"{self.rollout_cost:.9g}"),
            ("largest defect of a step, of the state's range", f"{defects.max():.2g}"),
            ("largest error of integrating a step, so too", f"{np.max(self.integration):.2g}"),
            ("growth of rounding errors in open loop", f"{self.growth:.2g}"),
        ]
        width = max(len(name) for name, _ in rows) + 2
        head = "Audit of a solution: " + ("sound" if self.sound else "NOT sound")
        return "\n".join([head, *(f"  {n:<{width}}{v}" for n, v in rows), *_reasons(self)])


def _reasons(audit: Audit) -> list[str]:
    """Say what differs, and why."""
    found, defects = [], np.asarray(audit.defects)
    if not np.isfinite(audit.cost):
        return ["its cost is not finite: a solve that failed; see its status"]
    if not _agree(audit.cost, audit.reported):
        found.append("along its own states it does not cost what was reported: another cost")
    if not defects.max() <= _eps(audit.cost) ** 0.75:
        worst = int(np.argmax(np.where(np.isnan(defects), np.inf, defects)))
        found.append(
            f"step {worst} does not lead to its next state: another plant, integrator or noise, or "
            "a solve that failed"
        )
    if not audit.excess <= _eps(audit.cost) ** 0.75:
        found.append("its controls are outside the problem's bounds: other bounds")
    if audit.integration.max() > COARSE:
        worst = int(np.argmax(audit.integration))
        found.append(
            f"step {worst} is too long to be integrated: cut into four it leads elsewhere, by "
            f"{audit.integration[worst]:.1g} of the state's range, and an optimum may live off "
            "such errors; shorten dt, or take a better integrator"
        )
    if audit.sound and not audit.reproducible:
        remedy = "its policy does: run that" if audit.controlled else "nor does its policy"
        found.append(
            "its controls alone do not lead along its states: the plant is unstable, and rounding "
            f"errors grow {audit.growth:.1g} times; {remedy}"
        )
    elif audit.sound and not audit.controlled:
        found.append(
            "its policy does not lead along its states, though its controls do: the policy of "
            "another solution"
        )
    return found


def _eps(values: Array) -> float:
    return float(jnp.finfo(values.dtype).eps)


def _agree(a: Array, b: Array) -> Array:
    return abs(a - b) <= _eps(a) ** 0.5 * jnp.maximum(abs(a), abs(b))


def audit(problem: Problem, solution: Solution) -> Audit:
    """Compute what a solution costs along its own states, and when it is run again.

    On an unstable plant over a long horizon a solution can be right and yet not be reproduced by
    its controls: with A the slope of a step, an error e becomes A e, and rounding makes one anew at
    each step, so that its covariance is S' = A S A' + 1 (in units of eps times each state's range).
    The audit tells this from a solution of another problem. Compiled the same way, controls may
    lead exactly along their states by luck; so the last digits are changed first, as another
    machine would.

    Arguments:
        problem: the one that was solved, or another to judge the solution by.
        solution: one solution; a batch goes through `jax.vmap`.

    Returns: `Audit`; print it, or ask `sound` and `reproducible`.

    Raises TypeError for what is no problem or solution, ValueError where their sizes differ.
    """
    if not isinstance(problem, Problem) or not isinstance(solution, Solution):
        raise TypeError(
            f"problem, solution: jc.Problem and jc.Solution are wanted, got a "
            f"{type(problem).__name__} and a {type(solution).__name__}"
        )
    problem.check_single()
    solution.policy.check(problem)
    problem, solution = promote((problem, solution))
    return _audit(problem, solution)


def _excess(problem: Problem, us: Array) -> Array:
    """Return how far controls (T, nu) are outside their bounds, over the largest; shape ()."""
    if problem.bounds is None:
        return jnp.zeros((), us.dtype)
    size = jnp.abs(us).max()
    outside = jnp.maximum(problem.bounds[0] - us, us - problem.bounds[1]).max()
    return jnp.maximum(outside, 0.0) / jnp.where(size > 0, size, 1.0)


def _in_quarters(problem: Problem, xs: Array, us: Array) -> Array:
    """Return each next state (T, nx) when each step is integrated in four."""
    if problem.plant.discrete or not problem.integrator.holds:
        return problem.replay(xs, us)
    dt = problem.dt / 4

    def four(x, u, t):
        for i in range(4):
            x = problem.integrator(problem.plant, x, u, t + i * dt, dt)
        return x

    return jax.vmap(four)(xs[:-1], us, problem.ts[:-1])


@jit
def _audit(problem: Problem, solution: Solution) -> Audit:
    xs, us = solution.xs, solution.us
    size = jnp.abs(xs).max(0)
    scale = jnp.where(size > 0, size, 1.0)
    slopes = jax.vmap(jax.jacfwd(problem.step))(xs[:-1], us, problem.ts[:-1])
    slopes = slopes * (scale / scale[:, None])

    def spread(S, A):
        S = A @ S @ A.T + jnp.eye(len(A), dtype=A.dtype)
        return S, jnp.diag(S).max()

    _, variances = jax.lax.scan(spread, jnp.zeros_like(slopes[0]), slopes)
    nudge = 1 + jnp.finfo(xs.dtype).eps
    x0, controls = xs[0] * nudge, us * nudge
    known = jnp.isfinite(slopes).all()
    overflown = known & ~jnp.isfinite(variances).all()
    after = problem.replay(xs, us)
    by_policy, alone = simulate(problem, solution.policy, x0), problem.rollout(x0, controls)
    return Audit(
        reported=solution.nominal_cost,
        cost=problem.total_cost(xs, us),
        policy_cost=by_policy.cost,
        rollout_cost=problem.total_cost(alone, controls),
        policy_drift=(jnp.abs(by_policy.xs - xs) / scale).max(),
        drift=(jnp.abs(alone - xs) / scale).max(),
        excess=_excess(problem, us),
        defects=(jnp.abs(after - xs[1:]) / scale).max(1),
        integration=(jnp.abs(after - _in_quarters(problem, xs, us)) / scale).max(1),
        growth=jnp.where(overflown, jnp.inf, jnp.sqrt(variances.max())),
    )
