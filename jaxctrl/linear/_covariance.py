"""Covariances of states and controls under gains, carried forward through a noisy local model."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._linalg import matmul, symmetrise
from .._types import LocalModel
from ._step import disturbance


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
            c, C = disturbance(stage.noise, K)
            after = after + c.T @ c
            if C is not None:
                after = after + jnp.einsum("ixj,jk,iyk->xy", C, X, C)
        after = symmetrise(after)
        return after, (after, symmetrise(matmul(matmul(K, X), K.T)))

    _, (xs, us) = jax.lax.scan(forth, x0_cov, (model.stages, K))
    return jnp.concatenate([x0_cov[None], xs]), us
