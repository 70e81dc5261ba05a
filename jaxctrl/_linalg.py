"""Small dense linear algebra in plain array operations, which XLA can compile into one function.

On a CPU the calls that XLA makes to its own library for a product, or to LAPACK for a
factorisation, cost more than a product of small matrices itself, and keep the loop around them
from becoming one native function.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

SMALL = 20
"""Up to this size a product is written out; above it the library's is faster (measured)."""
PIECE = 8
"""Sums of at most this length are unrolled by the compiler; longer ones are cut into such."""


def symmetrise(A: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return (A + A')/2, shape (n, n)."""
    return 0.5 * (A + A.T)


def matmul(A: Float[Array, "n m"], B: Float[Array, "m ..."]) -> Float[Array, "n ..."]:
    """Return A @ B, shape (n, p) for B (m, p) and (n,) for B (m,)."""
    if B.ndim == 1:
        return matmul(A, B[:, None])[:, 0]
    m = B.shape[0]
    if max(*A.shape, *B.shape) > SMALL or m == 0:
        return A @ B
    pieces = -(-m // PIECE)
    length = -(-m // pieces)
    out = jnp.zeros((), A.dtype)
    for k in range(0, m, length):
        part = slice(k, k + length)
        out = out + jnp.sum(A[:, part, None] * B[None, part, :], axis=1)
    return out


@jax.custom_jvp
def solve_positive(
    A: Float[Array, "n n"], B: Float[Array, "n m"]
) -> tuple[Float[Array, "n m"], Bool[Array, ""]]:
    """Solve A X = B for a symmetric positive definite A, by Gauss and Jordan's elimination.

    Without pivoting, as such an A needs none: a loop of n outer products, which compiles faster
    than a Cholesky factorisation written out and runs as fast. Derivatives are implicit,
    dX = A^-1 (dB - dA X).

    Returns: X (n, m), and whether every pivot was clearly positive (above eps times its diagonal
    entry); where not, X is of no meaning.
    """
    n = A.shape[0]
    diagonal = jnp.diagonal(A)
    floor = jnp.finfo(A.dtype).eps * jnp.abs(diagonal)
    if n == 1:
        ok = (diagonal > floor).all()
        return B / jnp.where(ok, A, 1.0), ok
    index = jnp.arange(n)

    def eliminate(j, carry):
        table, ok = carry
        row = jax.lax.dynamic_slice_in_dim(table, j, 1, axis=0)
        column = jax.lax.dynamic_slice_in_dim(table, j, 1, axis=1)
        pivot = jax.lax.dynamic_slice_in_dim(row, j, 1, axis=1)[0, 0]
        positive = pivot > jax.lax.dynamic_slice_in_dim(floor, j, 1)[0]
        row = row / jnp.where(positive, pivot, 1.0)
        return jnp.where((index == j)[:, None], row, table - column * row), ok & positive

    table = jnp.concatenate([A, B], axis=1)
    table, ok = jax.lax.fori_loop(0, n, eliminate, (table, jnp.array(True)))
    return table[:, n:], ok


@solve_positive.defjvp  # pyright: ignore[reportArgumentType]
def _solve_positive_jvp(primals, tangents):
    (A, B), (dA, dB) = primals, tangents
    m = B.shape[1]
    both, ok = solve_positive(A, jnp.concatenate([B, jnp.eye(A.shape[0], dtype=A.dtype)], axis=1))
    X, inverse = both[:, :m], both[:, m:]
    return (X, ok), (matmul(inverse, dB - matmul(dA, X)), np.zeros((), jax.dtypes.float0))


def root(S: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return L with L L' = S for a symmetric positive semidefinite S: Cholesky's, L lower.

    Where what is left of a diagonal entry is round-off the column is zero.
    """
    index, size = jnp.arange(S.shape[0]), jnp.diagonal(S)

    def column(S, j):
        pivot = S[j, j]
        positive = pivot > S.shape[0] * jnp.finfo(S.dtype).eps * size[j]
        scale = jnp.where(positive, 1 / jnp.sqrt(jnp.where(positive, pivot, 1.0)), 0.0)
        l = jnp.where(index >= j, S[:, j] * scale, 0.0)
        return S - l[:, None] * l, l

    return jax.lax.scan(column, S, index)[1].T


def is_covariance(S: Float[Array, "n n"]) -> Bool[Array, ""]:
    """Tell whether S is symmetric and positive semidefinite, but for rounding; shape ()."""
    L, size = root(S), jnp.sqrt(jnp.maximum(jnp.diagonal(S), 0.0))
    off = jnp.abs(matmul(L, L.T) - S)
    return (off <= jnp.finfo(S.dtype).eps ** 0.5 * size[:, None] * size).all()


@jax.custom_jvp
def solve_semidefinite(A: Float[Array, "n n"], B: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """Solve A X = B for a symmetric A >= 0, perhaps singular, and B in its range.

    The elimination of `solve_positive`, which leaves out each row whose pivot is no more than
    20 n eps of its diagonal entry, as those before it determine it; X is zero there. Derivatives
    are implicit, for changes that leave B in the range of A.

    Returns: X (n, m).
    """
    n = A.shape[0]
    diagonal = jnp.diagonal(A)
    # Rows and columns of equal size, whatever the units.
    size = jnp.where(diagonal > 0, 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0)), 0.0)
    least = 20 * n * jnp.finfo(A.dtype).eps
    index = jnp.arange(n)

    def eliminate(j, carry):
        table, used = carry
        row = jax.lax.dynamic_slice_in_dim(table, j, 1, axis=0)
        column = jax.lax.dynamic_slice_in_dim(table, j, 1, axis=1)
        pivot = jax.lax.dynamic_slice_in_dim(row, j, 1, axis=1)[0, 0]
        # What is not finite is let through, so that it shows.
        good = ~(pivot <= least)
        row = row / jnp.where(good, pivot, 1.0)
        after = jnp.where((index == j)[:, None], row, table - column * row)
        return jnp.where(good, after, table), used | (good & (index == j))

    table = jnp.concatenate([size[:, None] * A * size, size[:, None] * B], axis=1)
    table, used = jax.lax.fori_loop(0, n, eliminate, (table, jnp.zeros(n, bool)))
    return jnp.where(used[:, None], size[:, None] * table[:, n:], 0.0)


@solve_semidefinite.defjvp  # pyright: ignore[reportArgumentType]
def _solve_semidefinite_jvp(primals, tangents):
    (A, B), (dA, dB) = primals, tangents
    m = B.shape[1]
    both = solve_semidefinite(A, jnp.concatenate([B, jnp.eye(A.shape[0], dtype=A.dtype)], axis=1))
    X, inverse = both[:, :m], both[:, m:]
    return X, matmul(inverse, dB - matmul(dA, X))


@jax.custom_jvp
def positive_part(A: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return V max(D, 0) V' of a symmetric A = V D V', shape (n, n).

    Derivatives are those of Daleckii & Krein, which equal eigenvalues do not spoil.
    """
    values, vectors = jnp.linalg.eigh(A)
    return (vectors * jnp.maximum(values, 0.0)) @ vectors.T


@positive_part.defjvp
def _positive_part_jvp(primals, tangents):
    values, V = jnp.linalg.eigh(jax.lax.stop_gradient(primals[0]))
    part = jnp.maximum(values, 0.0)
    apart = values[:, None] - values
    equal = apart == 0
    slope = jnp.where(values > 0, 1.0, 0.0)[:, None]
    ratio = jnp.where(equal, slope, (part[:, None] - part) / jnp.where(equal, 1.0, apart))
    inner = V.T @ tangents[0] @ V
    return positive_part(primals[0]), V @ (ratio * inner) @ V.T
