"""Covariances of states and controls under gains, carried forward through a noisy local model."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._linalg import matmul, symmetrise
from .._types import LocalModel, Rows
from ._step import Packed, pack


def covariances(
    model: LocalModel, K: Float[Array, "T nu nx"], x0_cov: Float[Array, "nx nx"]
) -> tuple[Float[Array, "T+1 nx nx"], Float[Array, "T nu nu"]]:
    """Return the covariances of the deviations dx (T+1, nx, nx) and du (T, nu, nu).

    Under du = K dx, whose means are zero,

        X_{k+1} = F X_k F' + sum_i (c_i c_i' + C_i X_k C_i'),    U_k = K X_k K',

    with F = f_x + f_u K and C_i = cx_i + cu_i K (McLane 1971). Exact for the model.

    Arguments:
        model: local expansion with its noise, or without any.
        K: gains, (T, nu, nx).
        x0_cov: covariance of the first state, (nx, nx).
    """

    def forth(X, inputs):
        stage, K = inputs
        F = stage.fx + matmul(stage.fu, K)
        after = matmul(matmul(F, X), F.T)
        if stage.noise is not None:
            after = after + 2 * stage.noise.square + _spread(stage.noise, K, X)
        after = symmetrise(after)
        return after, (after, symmetrise(matmul(matmul(K, X), K.T)))

    stages = model.stages
    if model.noise is not None:
        stages = stages._replace(noise=pack(model.noise, model.fu.shape[1:]))
    _, (xs, us) = jax.lax.scan(forth, x0_cov, (stages, K))
    return jnp.concatenate([x0_cov[None], xs]), us


def _spread(noise: Packed, K: Float[Array, "nu nx"], X: Float[Array, "nx nx"]) -> Array:
    """Return sum_i C_i X C_i' (nx, nx) of the slopes C_i of a step's noise under gains K."""
    slopes, nx = noise.slopes, K.shape[1]
    if slopes is None:
        return jnp.zeros_like(X)
    return spread(noise.rows, slopes[..., :nx] + slopes[..., nx:] @ K, X, nx)


def spread(
    rows: Rows | None, C: Float[Array, "nw r nx"], X: Float[Array, "nx nx"], n: int
) -> Float[Array, "n n"]:
    """Return sum_i C_i X C_i' of slopes C_i, of which only the named rows are given."""
    nx = X.shape[0]
    CX = matmul(C.reshape(-1, nx), X).reshape(C.shape)
    if rows is None:
        # One product, of all columns side by side.
        left, right = (jnp.swapaxes(a, 0, 1).reshape(a.shape[1], -1) for a in (CX, C))
        return matmul(left, right.T)
    moments = jnp.sum(CX[:, :, None] * C[:, None], axis=3)
    S = rows.onehot(n, X.dtype)
    both = jnp.sum(moments[..., None] * S[:, None], axis=2)
    return matmul(jnp.asarray(S).reshape(-1, n).T, both.reshape(-1, n))
