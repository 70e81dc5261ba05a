"""The sensorimotor problem of Todorov (2005), and its law and filter."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._types import LocalModel, Noise, Sensing
from ._observed_checks import checked, covariance
from ._observed_doors import check_form, observed_lqg


class MultiplicativeLQG(NamedTuple):
    """The control law u = k - L xhat and the filter's gains K that were found.

    k is zero, but in the corrected form with noise of the estimator's own, where the best linear
    guess of the state depends on what is expected of it too. `cost` is the expected cost, and
    `history` what it was after each half of each sweep, the filter's and the law's, NaN for sweeps
    that were not needed. `converged` tells whether the last sweep changed it by no more than the
    tolerance, or round-off.
    """

    L: Float[Array, "T nu nx"]
    K: Float[Array, "T nx ny"]
    k: Float[Array, "T nu"]
    cost: Float[Array, ""]
    history: Float[Array, "max_steps 2"]
    num_steps: Int[Array, ""]
    converged: Bool[Array, ""]


def signal_dependent(
    A: ArrayLike,
    B: ArrayLike,
    C: ArrayLike | None,
    C0: ArrayLike | None,
    H: ArrayLike,
    D: ArrayLike | None,
    D0: ArrayLike | None,
    E0: ArrayLike | None,
    Q: ArrayLike,
    R: ArrayLike,
    X1: ArrayLike,
    S1: ArrayLike,
) -> tuple[LocalModel, Sensing, Array, Array]:
    """Return the problem of `multiplicative_lqg` as a model, a sensing, X1 (nx,) and S1 (nx, nx).

    The cost there has no factor 1/2, so that l_xx = 2 Q and l_uu = 2 R.

    Arguments: as in `multiplicative_lqg`. Raises: as there.
    """
    Q = checked("Q", Q, (None, None, None))
    T, nx = Q.shape[0] - 1, Q.shape[1]
    if T < 1:
        raise ValueError("Q: two times at least are wanted, (T+1, nx, nx), got one")
    Q = checked("Q", Q, (T + 1, nx, nx))
    A = _every("A", A, T, (nx, nx))
    B = _every("B", B, T, (nx, None))
    H = _every("H", H, T, (None, nx))
    nu, ny = B.shape[2], H.shape[1]
    R = _every("R", R, T, (nu, nu))
    C = None if C is None else B[:, None] @ checked("C", C, (None, nu, nu))
    D = None if D is None else jnp.tile(checked("D", D, (None, ny, nx)), (T, 1, 1, 1))
    steps = (_columns(n, v, T, m) for n, v, m in (("C0", C0, nx), ("D0", D0, ny), ("E0", E0, nx)))
    c, d, internal = steps
    zero = jnp.zeros((), Q.dtype)
    model = LocalModel(
        fx=A,
        fu=B,
        lx=jnp.tile(zero, (T, nx)),
        lu=jnp.tile(zero, (T, nu)),
        lxx=2 * Q[:-1],
        lux=jnp.tile(zero, (T, nu, nx)),
        luu=2 * R,
        vx=jnp.tile(zero, nx),
        vxx=2 * Q[-1],
        noise=_stack(c, None, C),
    )
    sensing = Sensing(H, noise=_stack(d, D, None), internal=internal)
    return model, sensing, checked("X1", X1, (nx,)), covariance("S1", S1, nx)


def _every(name: str, value: ArrayLike, T: int, shape: tuple[int | None, int | None]) -> Array:
    """Return a matrix, or one for each of T steps, as (T, rows, columns)."""
    if jnp.ndim(value) == 3:
        return checked(name, value, (T, *shape))
    array = checked(name, value, shape)
    return jnp.broadcast_to(array, (T, *array.shape))


def _columns(name: str, root: ArrayLike | None, T: int, rows: int) -> Array | None:
    """Return the columns of a covariance's root (rows, n) at every step, (T, n, rows)."""
    if root is None:
        return None
    array = checked(name, root, (rows, None))
    return jnp.broadcast_to(array.T, (T, *array.T.shape))


def _stack(c: Array | None, cx: Array | None, cu: Array | None) -> Noise | None:
    """Return columns of which some are constant and the others proportional to one thing."""
    slope = cu if cx is None else cx
    if slope is None:
        return None if c is None else Noise(c)
    flat = jnp.zeros(slope.shape[:3], slope.dtype)
    if c is not None:
        slope = jnp.pad(slope, ((0, 0), (0, c.shape[1]), (0, 0), (0, 0)))
        flat = jnp.concatenate([flat, c], axis=1)
    return Noise(flat, cu=slope) if cx is None else Noise(flat, cx=slope)


def multiplicative_lqg(
    A: Float[ArrayLike, "*T nx nx"],
    B: Float[ArrayLike, "*T nx nu"],
    C: Float[ArrayLike, "nc nu nu"] | None,
    C0: Float[ArrayLike, "nx n0"] | None,
    H: Float[ArrayLike, "*T ny nx"],
    D: Float[ArrayLike, "nd ny nx"] | None,
    D0: Float[ArrayLike, "ny m0"] | None,
    E0: Float[ArrayLike, "nx e0"] | None,
    Q: Float[ArrayLike, "T+1 nx nx"],
    R: Float[ArrayLike, "*T nu nu"],
    X1: Float[ArrayLike, " nx"],
    S1: Float[ArrayLike, "nx nx"],
    *,
    form: str = "corrected",
    tolerance: float | None = None,
    max_steps: int = 500,
) -> MultiplicativeLQG:
    """Minimise a quadratic cost under noise that grows with controls and states.

        x'    = A x + B (I + sum_i C_i a_i) u + C0 b
        y     = H x + sum_i D_i x d_i + D0 w
        xhat' = A xhat + B u + K (y - H xhat) + E0 o,    u = k - L xhat
        J     = E sum_{t=1..T+1} x'Q_t x + sum_{t=1..T} u'R u

    with all of a, b, d, w and o independent, of variance 1 (Todorov 2005, Neural Comput. 17:1084;
    the arguments are those of its program kalman_lqg). No cost has a factor 1/2.

    Arguments:
        A, B: plant, (nx, nx) and (nx, nu), or one for each step, leading with time.
        C: how the control's noise grows with it, (nc, nu, nu), the columns' index leading.
        C0: root of the covariance of the additive noise, (nx, n0).
        H: sensor, (ny, nx), or one for each step.
        D: how the sensor's noise grows with the state, (nd, ny, nx).
        D0: root of the covariance of its additive noise, (ny, m0).
        E0: root of the covariance of the estimator's own noise, (nx, e0).
        Q: cost of the state, (T+1, nx, nx). R: of the control, (nu, nu) or one for each step.
        X1: mean of the first state, and first estimate, (nx,). S1: its covariance, (nx, nx).
        form, tolerance, max_steps: as in `observed_lqg`; "published" gives what kalman_lqg does.
        None stands for any noise that there is not.

    Returns: `MultiplicativeLQG`.

    Raises: ValueError for shapes that do not fit together, for numbers that are not finite and for
        an S1 that is no covariance; TypeError for what is no number; each names the argument.
    """
    check_form(form)
    model, sensing, mean, cov = signal_dependent(A, B, C, C0, H, D, D0, E0, Q, R, X1, S1)
    found = observed_lqg(
        model, sensing, cov, mean, form=form, tolerance=tolerance, max_steps=max_steps
    )
    law, gains, cost, history, count, converged, _ = found
    return MultiplicativeLQG(-law.K, gains, law.k, cost, history, count, converged)
