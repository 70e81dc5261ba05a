"""Small dense linear algebra: Cholesky written out over the static size, which XLA can fuse."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

UNROLLED = 8
"""Up to this size the factorisation is written out; above it LAPACK is faster."""


def symmetrise(A: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return (A + A')/2, shape (n, n)."""
    return 0.5 * (A + A.T)


def cholesky(A: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Bool[Array, ""]]:
    """Factorise a symmetric A = LL'.

    Returns L (n, n), and whether every pivot was clearly positive (above eps times its diagonal
    entry); where not, L is the identity, so that nothing downstream turns NaN.
    """
    n = A.shape[0]
    floor = jnp.finfo(A.dtype).eps * jnp.abs(jnp.diagonal(A))
    if n <= UNROLLED:
        rows: list[list[Array]] = []
        ok = jnp.array(True)
        for i in range(n):
            row: list[Array] = []
            for j in range(i):
                inner = sum((row[m] * rows[j][m] for m in range(j)), jnp.zeros((), A.dtype))
                row.append((A[i, j] - inner) / rows[j][j])
            pivot = A[i, i] - sum((r * r for r in row), jnp.zeros((), A.dtype))
            positive = pivot > floor[i]
            ok &= positive
            row.append(jnp.sqrt(jnp.where(positive, pivot, 1.0)))
            rows.append(row)
        zero = jnp.zeros((), A.dtype)
        L = jnp.stack([jnp.stack(row + [zero] * (n - len(row))) for row in rows])
    else:
        L = jax.lax.linalg.cholesky(A, symmetrize_input=False)
        ok = jnp.all(jnp.square(jnp.diagonal(L)) > floor)
    return jnp.where(ok, L, jnp.eye(n, dtype=A.dtype)), ok


def cholesky_solve(L: Float[Array, "n n"], B: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """Solve LL'X = B for X (n, m)."""
    n = L.shape[0]
    if n > UNROLLED:
        half = jax.lax.linalg.triangular_solve(L, B, left_side=True, lower=True)
        return jax.lax.linalg.triangular_solve(
            L, half, left_side=True, lower=True, transpose_a=True
        )
    Y: list[Array] = []
    for i in range(n):
        Y.append((B[i] - sum((L[i, j] * Y[j] for j in range(i)), jnp.zeros_like(B[i]))) / L[i, i])
    X: list[Array] = [Y[0]] * n
    for i in reversed(range(n)):
        known = sum((L[j, i] * X[j] for j in range(i + 1, n)), jnp.zeros_like(B[i]))
        X[i] = (Y[i] - known) / L[i, i]
    return jnp.stack(X)
