"""The kernels as users call them: compiled; what is inside a loop calls the plain ones."""

import functools
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import ArrayLike, Float

from .._types import LocalModel, array_leaf
from . import _box_lqr, _boxqp, _factorised, _riccati
from ._boxqp import BoxQP
from ._engine import find_engine
from ._observed_checks import check_model, shaped
from ._riccati import Sweep, symmetric


def _compiled(kernel: Callable) -> Callable:
    """Return a kernel of a model as users call it."""

    @functools.wraps(kernel)
    def call(model, *args, **kwargs):
        check_model(model)
        return kernel(symmetric(model), *args, **kwargs)

    return eqx.filter_jit(call)


_box_lqr_door = _compiled(_box_lqr.box_lqr)
_box_qp = eqx.filter_jit(_boxqp.box_qp)
costates = eqx.filter_jit(_riccati.costates)
_evaluate = _compiled(_riccati.evaluate)
factorise = _compiled(_factorised.factorise)
solve_factorised = eqx.filter_jit(_factorised.solve_factorised)
lqr_rollout = eqx.filter_jit(_factorised.lqr_rollout)


@functools.wraps(_riccati.evaluate)
def evaluate(model, k, K):
    T, nx, nu = check_model(model)
    return _evaluate(model, shaped("k", k, (T, nu)), shaped("K", K, (T, nu, nx)))


def lqr(
    model: LocalModel,
    damping: ArrayLike | Float[ArrayLike, "T nu"] = 0.0,
    *,
    engine: str = "sequential",
) -> Sweep:
    """Minimise a local model's cost by a Riccati sweep.

        V_k(dx) = min_du l_k + V_{k+1}(fx dx + fu du),    du = k + K dx

    Damping d >= 0 adds sum_ki d_ki du_ki^2 / 2 to the model (Levenberg and Marquardt).

    Arguments:
        model: local expansion; every array but the last two leads with time.
        damping: d, scalar or (T, nu) [cost per control unit squared].
        engine: "sequential", or "parallel" in time (Sarkka & Garcia-Fernandez 2023), which gives
            the same result, is made for accelerators and has no reverse-mode derivative.

    Returns: `Sweep`.

    Raises: ValueError for an unknown engine.
    """
    return _lqr(model, jnp.asarray(damping, model.lu.dtype), engine)


@eqx.filter_jit
def _lqr(model: LocalModel, damping, engine: str) -> Sweep:
    check_model(model)
    return find_engine(engine).lqr(symmetric(model), damping)


@functools.wraps(_box_lqr.box_lqr)
def box_lqr(model, lower, upper, *args, **kwargs):
    _boxqp.check_bounds(lower, upper)  # behind jit they are traced
    return _box_lqr_door(model, lower, upper, *args, **kwargs)


@functools.wraps(_boxqp.box_qp)
def box_qp(H, g, lower, upper, *, max_steps: int = 1000) -> BoxQP:
    _boxqp.check_bounds(lower, upper)
    H = array_leaf(H, "H")
    return _box_qp(0.5 * (H + H.mT), array_leaf(g, "g"), lower, upper, max_steps=max_steps)
