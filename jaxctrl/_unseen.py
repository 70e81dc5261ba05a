"""A warning for sensors that leave an unstable motion of the plant unseen."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._checks import is_concrete
from ._jacobian import jacobian
from ._jit import jit
from ._problem import Problem
from ._sensor import reading

GROWTH = 10.0
"""An unseen error that grows by no more than this in the whole movement is let pass."""
UNSEEN = 1e-8
"""What is sensed of a motion, relative to what might be, that counts as nothing."""


def warn_unseen(problem: Problem, x0: Float[Array, " nx"]) -> None:
    """Warn where the sensor tells nothing of an unstable motion around the start x0 (nx,).

    Hautus' test: of an eigenvalue z of the step's Jacobian A, and of F, that of what is sensed, no
    vector may have both (A - z) v = 0 and F v = 0. Nothing is said of traced problems.
    """
    if not is_concrete(*jax.tree.leaves((problem, x0))):
        return
    A, F = map(np.asarray, _slopes(problem, x0))
    if not (np.isfinite(A).all() and np.isfinite(F).all()):
        return  # the solve will say so
    rows = F / np.maximum(np.abs(F).max(axis=1, keepdims=True), np.finfo(F.dtype).tiny)
    for value in np.linalg.eigvals(A):
        growth = np.abs(value) ** problem.num_steps
        if growth <= GROWTH or value.imag < 0:
            continue
        both = np.concatenate([(A - value * np.eye(len(A))) / np.abs(A).max(), rows])
        _, sizes, vectors = np.linalg.svd(both)
        if sizes[-1] <= UNSEEN * sizes[0]:
            state = int(np.abs(vectors[-1]).argmax())
            warnings.warn(
                f"sensor: it tells nothing of an unstable motion around x0, mostly of state "
                f"{state}, which grows {growth:.3g} times in the movement: no filter can know it",
                stacklevel=4,
            )


@jit
def _slopes(problem: Problem, x0) -> tuple[Array, Array]:
    """Return the Jacobians of a step at rest (nx, nx), and of what is sensed (ny, nx)."""
    sensor, t, u = problem.sensor, problem.ts[0], problem.nominal_controls[0]
    assert sensor is not None
    A = jacobian(lambda x, t: problem.step(x, u, t))(x0, t)
    return A, jacobian(lambda x, t: reading(sensor, problem.plant, x, t))(x0, jnp.asarray(t))
