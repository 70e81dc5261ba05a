"""Minimise a small strictly convex quadratic in a box, by pivoting on the set of held variables.

With r = g + Hx, the minimiser is the one x with r_i = 0 where lower_i < x_i < upper_i, r_i >= 0 at
a lower bound and r_i <= 0 at an upper one (Karush, Kuhn & Tucker).
"""

from typing import NamedTuple

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._linalg import matmul, solve_positive

PATIENCE = 3
"""How many sets in a row may violate no fewer conditions before changes become single ones."""
ROUND_OFF = 100.0
"""Within how many eps of the sizes of its terms a component of r counts as zero."""


class BoxQP(NamedTuple):
    """Outcome of `box_qp`: the minimiser, the free set, and whether it is one."""

    x: Float[Array, " n"]
    free: Bool[Array, " n"]
    positive: Bool[Array, ""]
    finished: Bool[Array, ""]
    num_steps: Int[Array, ""]


class _Iterate(NamedTuple):
    """A point x (n,), perhaps outside the box, and what to hold next: -1 at the lower bound, 1 at
    the upper, 0 nothing; the fewest violations so far, and how many more sets may have as many."""

    x: Float[Array, " n"]
    side: Float[Array, " n"]
    fewest: Int[Array, ""]
    patience: Int[Array, ""]
    positive: Bool[Array, ""]
    finished: Bool[Array, ""]
    num_steps: Int[Array, ""]


def box_qp(
    H: Float[Array, "n n"],
    g: Float[Array, " n"],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
    *,
    max_steps: int = 1000,
) -> BoxQP:
    """Minimise g'x + x'Hx/2 subject to lower <= x <= upper.

    Hold some variables at bounds and solve for the others; then hold what left the box, and
    release what its multiplier pushes inwards (the primal-dual active set; Hintermueller, Ito &
    Kunisch 2002). Where that does not lessen the number of violations, only one of them, the last,
    is mended at a time, which ends for every positive definite H (Murty 1974; block principal
    pivoting of Judice & Pires 1994). Each solve starts from the last point, so that a set that
    repeats refines it.

    It is finished when r = g + Hx satisfies the conditions of a minimum at the point returned, each
    r_i within 100 eps of |g_i| + sum_j |H_ij x_j|, the sizes of its terms. Inputs that are not
    finite never are; bounds may be infinite.

    Derivatives are those of the minimiser by the implicit function theorem, forward and reverse;
    where the multiplier of a bound is zero they are those of one side. NaN unless finished.

    Arguments:
        H: symmetric, positive definite, shape (n, n); over the variables with room alone.
        g: shape (n,). lower, upper: shape (n,), infinite where there is no bound.
        max_steps: limit of the number of solves.

    Returns: `BoxQP`: x (n,), inside the box always; the free set (n,); whether H was positive
    definite on every set that was met; whether it finished.

    Raises: ValueError where lower > upper; when they are traced, it does not finish instead.
    """
    H, g, lower, upper = (jnp.asarray(a, jnp.result_type(H, g)) for a in (H, g, lower, upper))
    check_bounds(lower, upper)
    fixed = jax.lax.stop_gradient((H, g, lower, upper))
    end = _pivot(*fixed, max_steps)
    x = jnp.clip(end.x, lower, upper)
    r = g + matmul(H, x)
    free = (lower < upper) & ~(((x <= lower) & (r > 0)) | ((x >= upper) & (r < 0)))
    x = _attach(jax.lax.stop_gradient(x), H, g, lower, upper, free, end.finished)
    return BoxQP(x, free, end.positive, end.finished, end.num_steps)


def check_bounds(lower: ArrayLike, upper: ArrayLike) -> None:
    """Raise ValueError where bounds that are known have changed places."""
    if any(isinstance(bound, jax.core.Tracer) for bound in (lower, upper)):
        return
    low, high = np.asarray(lower), np.asarray(upper)
    if (low > high).any():
        low, high = np.broadcast_arrays(low, high)
        i = tuple(int(n) for n in np.argwhere(low > high)[0])
        at = i[0] if len(i) == 1 else i
        raise ValueError(
            f"lower <= upper is wanted, got {low[i]} > {high[i]} at index {at}; were they "
            "exchanged?"
        )


def _residual(H, g, x):
    """Return r = g + Hx and eps times the sizes of its terms, each (n,)."""
    sizes = jnp.abs(g) + matmul(jnp.abs(H), jnp.abs(x))
    return g + matmul(H, x), jnp.finfo(x.dtype).eps * sizes


def solve_free(H, free, B):
    """Return H_FF^-1 B_F, zero elsewhere, (n, m), and whether H_FF is positive definite."""
    within = jnp.where(free[:, None] & free, H, jnp.eye(free.size, dtype=H.dtype))
    return solve_positive(within, jnp.where(free[:, None], B, 0.0))


def _minimal(H, g, lower, upper, x) -> Bool[Array, ""]:
    """Tell whether x (n,), in the box, satisfies the conditions of a minimum up to rounding."""
    r, eps = _residual(H, g, x)
    rising, falling = r >= -ROUND_OFF * eps, r <= ROUND_OFF * eps
    stationary = ((x <= lower) | falling) & ((x >= upper) | rising)
    return (stationary & (lower <= upper) & jnp.isfinite(x) & jnp.isfinite(eps)).all()


def _pivot(H, g, lower, upper, max_steps) -> _Iterate:
    """Change the set of held variables until the conditions of a minimum are met."""
    room = lower < upper

    def body(at: _Iterate) -> _Iterate:
        x = jnp.where(at.side < 0, lower, jnp.where(at.side > 0, upper, at.x))
        step, positive = solve_free(H, at.side == 0, _residual(H, g, x)[0][:, None])
        x = x - step[:, 0]
        finished = positive & _minimal(H, g, lower, upper, jnp.clip(x, lower, upper))
        following = jnp.where(room, _following(H, g, lower, upper, x, at.side), at.side)
        wrong = following != at.side
        count, last = jnp.sum(wrong), wrong & (jnp.cumsum(wrong[::-1])[::-1] == 1)
        patience = jnp.where(count < at.fewest, PATIENCE, at.patience - 1)
        side = jnp.where((patience >= 0) | last, following, at.side)
        fewest = jnp.minimum(at.fewest, count)
        return _Iterate(x, side, fewest, patience, positive, finished, at.num_steps + 1)

    def unfinished(at: _Iterate):
        good = at.positive & jnp.isfinite(at.x).all()
        return good & ~at.finished & (at.num_steps < max_steps)

    start = jnp.clip(jnp.zeros_like(g), lower, upper)
    side = jnp.where(room, 0.0, -1.0).astype(g.dtype)
    fewest, patience, count = (jnp.array(n) for n in (g.size + 1, PATIENCE, 0))
    first = _Iterate(start, side, fewest, patience, jnp.array(True), jnp.array(False), count)
    return jax.lax.while_loop(unfinished, body, first)


def _following(H, g, lower, upper, x, side):
    """Return which side to hold each variable at next, (n,), after solving with `side` held."""
    r, eps = _residual(H, g, x)
    diagonal = jnp.diagonal(H)
    slack = eps / jnp.where(diagonal > 0, diagonal, 1.0)
    left = jnp.where(x < lower - slack, -1.0, jnp.where(x > upper + slack, 1.0, 0.0))
    outside = jnp.where(x < lower, -1.0, jnp.where(x > upper, 1.0, 0.0))
    following = jnp.where(side == 0, left, jnp.where(side * r <= eps, side, 0.0))
    # What is outside by rounding alone is held once nothing else is amiss.
    settled = (following == side).all()
    return jnp.where(settled & (side == 0), outside, following).astype(x.dtype)


@jax.custom_jvp
def _attach(x, H, g, lower, upper, free, finished):
    """Return the minimiser x (n,) with its derivatives."""
    return x


@_attach.defjvp
def _attach_jvp(primals, tangents):
    x, H, g, lower, upper, free, finished = primals
    _, dH, dg, dlower, dupper, _, _ = tangents
    x = _attach(x, H, g, lower, upper, free, finished)
    r = jax.lax.stop_gradient(g + matmul(H, x))
    bound = jnp.where((x <= lower) & ((r >= 0) | (x < upper)), dlower, dupper)
    held = jnp.where(free, 0.0, bound)
    # The inverse itself, as reverse mode transposes products, not an elimination.
    inverse, _ = solve_free(H, free, jnp.eye(x.size, dtype=x.dtype))
    step = matmul(inverse, dg + matmul(dH, x) + matmul(H, held))
    return x, jnp.where(finished, 1.0, jnp.nan) * (held - step)
