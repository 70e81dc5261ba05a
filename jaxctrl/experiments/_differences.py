"""Differential dynamic programming with the dynamics' Hessians from differences, as in 2006."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxctrl as jc


class DifferencedDDP(jc.AbstractShooting):
    """The textbook's `DDP`, with sum_i p_i (f_i)_zz, z = (x, u), from central differences.

        f_ij = (f(+i, +j) - f(+i, -j) - f(-i, +j) + f(-i, -j)) / (4 h_i h_j),

    for each step of time: 2 n^2 + 1 evaluations of the step, n = nx + nu (`evaluations`). All else
    is that of `DDP(start="exact")`: costates, damping, line search; first derivatives are exact.
    For problems without events and `AbstractResidual`s, which have second derivatives too.
    """

    second_order: ClassVar[bool] = False
    stochastic: ClassVar[bool] = False
    textbook: jc.DDP = jc.DDP(start="exact")
    gradient_tolerance: float | None = eqx.field(static=True, default=None)
    cost_tolerance: float | None = eqx.field(static=True, default=None)
    step_tolerance: float | None = eqx.field(static=True, default=None)

    def expand(self, problem, xs, us, near):
        """Return the model with the second order of the dynamics, wherever it is."""
        model = jc.expand(problem, xs, us)
        p, _ = jc.linear.costates(model)
        zs = jnp.concatenate([xs[:-1], us], axis=1)
        nx = problem.plant.nx

        def hessian(z, t, p):
            return differences(lambda z: p @ problem.step(z[:nx], z[nx:], t), z)

        added = jax.vmap(hessian)(zs, problem.ts[:-1], p)
        return model._replace(
            lxx=model.lxx + added[:, :nx, :nx],
            lux=model.lux + added[:, nx:, :nx],
            luu=model.luu + added[:, nx:, nx:],
        )

    def law(self, model, damping, box, guess, last):
        """Return the model's minimiser, and what it holds at bounds, as `DDP` does."""
        return self.textbook.law(model, damping, box, guess, last)

    def merit(self, problem, xs, us, law, model=None):
        """Return the nominal cost, shape ()."""
        return problem.total_cost(xs, us)


def differences(f, z):
    """Return the Hessian (n, n) of a function of z (n,) by 2 n^2 + 1 evaluations of it.

    Steps are eps^(1/4) of each number, or of 1 where it is smaller: rounding and truncation then
    weigh alike.
    """
    n = z.size
    i, j = np.triu_indices(n)
    apart = i != j
    h = jnp.finfo(z.dtype).eps ** 0.25 * jnp.maximum(1.0, jnp.abs(z))
    e, f = jnp.diag(h), jax.vmap(f)
    alike = f(z + e[i] + e[j]) + f(z - e[i] - e[j])
    across = f(z + e[i[apart]] - e[j[apart]]) + f(z - e[i[apart]] + e[j[apart]])
    across = jnp.full(i.size, 2 * f(z[None])[0]).at[np.flatnonzero(apart)].set(across)
    half = jnp.zeros((n, n), z.dtype).at[i, j].set((alike - across) / (4 * h[i] * h[j]))
    return half + half.T - jnp.diag(jnp.diag(half))


def evaluations(problem: jc.Problem) -> tuple[int, int]:
    """Return how often central differences evaluate a step of time, for slopes and for Hessians.

    2 n, and 2 n^2 + 1, which hold those for slopes (at 2 h along each axis); n = nx + nu.
    """
    n = problem.plant.nx + problem.plant.nu
    return 2 * n, 2 * n * n + 1
