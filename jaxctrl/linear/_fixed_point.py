"""Derivatives of a fixed point p = s(inputs, p) that an iteration has found.

    dp = s_p dp + s_inputs dinputs,

solved by the series that the iteration itself would have followed.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

MOST = 1000
"""Limit of the series."""


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def attach(sweep: Callable[[Any, Any], Any], inputs: Any, point: Any, fixed: Array) -> Any:
    """Return a fixed point with its derivatives, NaN unless `fixed`.

    Arguments:
        sweep: the iteration, `sweep(inputs, point)`; closes over nothing that is traced.
        inputs, point: trees of arrays.
        fixed: whether `point` is where the iteration stays, ().
    """
    return point


@attach.defjvp
def _attach_jvp(sweep, primals, tangents):
    inputs, point, fixed = primals
    _, pushed = jax.jvp(lambda i: sweep(i, point), (inputs,), (tangents[0],))
    _, through = jax.linearize(lambda p: sweep(inputs, p), point)

    def left(change):
        return jax.tree.map(jnp.subtract, change, through(change))

    slope = jax.lax.custom_linear_solve(left, pushed, _series, transpose_solve=_series)
    valid = jnp.where(fixed, 1.0, jnp.nan)
    return attach(sweep, *primals), jax.tree.map(lambda a: valid.astype(a.dtype) * a, slope)


def _series(left, b):
    """Solve x - s x = b by x <- b + s x, which converges as the sweeps did."""

    def body(carry):
        x, _, count = carry
        rest = jax.tree.map(jnp.subtract, b, left(x))
        after = jax.tree.map(jnp.add, x, rest)
        return after, _norm(rest) / _norm(after), count + 1

    def unfinished(carry):
        _, change, count = carry
        return (count < MOST) & (change > 10 * jnp.finfo(change.dtype).eps)

    start = (b, jnp.full((), jnp.inf, jax.tree.leaves(b)[0].dtype), jnp.array(0))
    return jax.lax.while_loop(unfinished, body, start)[0]


def _norm(tree) -> Array:
    total = sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(tree))
    return jnp.sqrt(total)
