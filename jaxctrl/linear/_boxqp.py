"""Minimise a small convex quadratic in a box, by projected Newton."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._linalg import solve_positive


class BoxQP(NamedTuple):
    """Outcome of `box_qp`: the minimiser, the free set, and whether it is one."""

    x: Float[Array, " n"]
    free: Bool[Array, " n"]
    positive: Bool[Array, ""]
    finished: Bool[Array, ""]
    num_steps: Int[Array, ""]


def _free_set(x, gradient, lower, upper):
    return ~(((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0)))


def box_qp(
    H: Float[Array, "n n"],
    g: Float[Array, " n"],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
    *,
    max_steps: int = 20,
) -> BoxQP:
    """Minimise g'x + x'Hx/2 subject to lower <= x <= upper.

    Projected Newton (Bertsekas 1982; Tassa, Mansard & Todorov 2014): the coordinates held at a
    bound by their gradient are fixed, a Newton step is taken in the others, projected, and halved
    until the quadratic falls enough. It is finished when the free set repeats and the gradient in
    it is at round-off.

    Arguments:
        H: symmetric, positive definite on the free set, shape (n, n).
        g: shape (n,). lower, upper: shape (n,), infinite where there is no bound.
        max_steps: limit of the iteration.

    Returns: `BoxQP`: x (n,), inside the box always; the free set (n,); whether H was positive
    definite there; whether it finished.
    """
    eps = jnp.finfo(H.dtype).eps
    halvings = 0.5 ** jnp.arange(8, dtype=H.dtype)

    def value(x):
        return x @ (g + 0.5 * (H @ x))

    def measure(x):
        gradient = g + H @ x
        free = _free_set(x, gradient, lower, upper)
        scale = jnp.abs(g) + jnp.abs(H) @ jnp.abs(x)
        rest = jnp.where(free, jnp.abs(gradient), 0.0)
        return gradient, free, jnp.all(rest <= 100 * eps * scale)

    def body(carry):
        x, _, _, _, num = carry
        gradient, free, finished = measure(x)
        residual = jnp.where(free, gradient, 0.0)
        on_free = jnp.where(free[:, None] & free, H, jnp.eye(g.size, dtype=H.dtype))
        solved, positive = solve_positive(on_free, residual[:, None])
        newton = -solved[:, 0]
        trials = jnp.clip(x + halvings[:, None] * newton, lower, upper)
        falls = jax.vmap(value)(trials) - value(x)
        enough = falls <= 0.1 * (trials - x) @ residual
        # Where no trial falls enough the quadratic is flat at round-off: the smallest step ends it.
        step = trials[jnp.where(enough.any(), jnp.argmax(enough), -1)]
        x = jnp.where(finished | ~positive, x, step)
        return x, free, positive, finished | ~enough.any(), num + 1

    def unfinished(carry):
        _, _, positive, finished, num = carry
        return positive & ~finished & (num < max_steps)

    start = jnp.clip(jnp.zeros_like(g), lower, upper)
    true, false = jnp.array(True), jnp.array(False)
    carry = (start, true | (g == g), true, false, jnp.array(0))
    return BoxQP(*jax.lax.while_loop(unfinished, body, carry))
