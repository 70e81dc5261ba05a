"""The kernels of sensed models as users call them: checked, then compiled."""

import functools

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import ArrayLike, Float

from .._types import Bounds, LocalModel, Sensing, as_bounds, promote
from . import _coordinate_descent, _moments, _observed, _sensed
from ._boxqp import check_bounds
from ._coordinate_descent import Observed, ObservedLQG
from ._moments import AffineLaw, Moments
from ._observed_checks import check_model, check_sensed, checked, covariance
from ._riccati import symmetric
from ._sensed import SensedLQG

FORMS = ("corrected", "published")


def _check_law(law: AffineLaw, T: int, nx: int, nu: int) -> AffineLaw:
    if not isinstance(law, tuple) or len(law) != 2:
        raise TypeError(f"law: a jc.linear.AffineLaw is wanted, got {type(law).__name__}")
    return AffineLaw(checked("law.k", law[0], (T, nu)), checked("law.K", law[1], (T, nu, nx)))


def check_form(form: str) -> None:
    if form not in FORMS:
        raise ValueError(f"form: one of {FORMS} is wanted, got {form!r}")


@functools.wraps(_observed.evaluate_observed)
def evaluate_observed(model, sensing, law, gains):
    T, nx, nu, ny = check_sensed(model, sensing)
    law = _check_law(law, T, nx, nu)
    return _evaluate(*promote((model, sensing, law, checked("gains", gains, (T, nx, ny)))))


@eqx.filter_jit
def _evaluate(model, sensing, law, gains):
    return _observed.evaluate_observed(symmetric(model), sensing, law, gains)


def observed_moments(
    model: LocalModel,
    sensing: Sensing,
    law: AffineLaw,
    gains: Float[ArrayLike, "T nx ny"],
    cov: Float[ArrayLike, "nx nx"],
    mean: Float[ArrayLike, " nx"] | None = None,
    estimate: Float[ArrayLike, " nx"] | None = None,
) -> Moments:
    """Return means and covariances of states, estimates and controls, and the expected cost.

    They are carried forward exactly, for any affine law and any filter, whatever the distributions
    of the noise and of the start.

    Arguments:
        model: local expansion of plant and cost.
        sensing: local expansion of the sensor, and the estimator's own noise.
        law: du = k + K xhat, k (T, nu) and K (T, nu, nx).
        gains: those of the filter, (T, nx, ny).
        cov: covariance of the first state, (nx, nx).
        mean: its mean, (nx,), zero by default.
        estimate: the first estimate, (nx,), which is not random; the mean by default.

    Returns: `Moments`.

    Raises: ValueError for shapes that do not fit together and for what is no covariance, naming the
        argument.
    """
    T, nx, nu, ny = check_sensed(model, sensing)
    law = _check_law(law, T, nx, nu)
    gains, cov = checked("gains", gains, (T, nx, ny)), covariance("cov", cov, nx)
    mean = jnp.zeros_like(model.vx) if mean is None else checked("mean", mean, (nx,))
    estimate = mean if estimate is None else checked("estimate", estimate, (nx,))
    return _moments_of(*promote((model, sensing, law, gains, cov, mean, estimate)))


@eqx.filter_jit
def _moments_of(model, sensing, law, gains, cov, mean, estimate):
    start = _moments.starting(mean, cov, estimate)
    return _moments.moments(symmetric(model), sensing, law, gains, start)


def filter_gains(
    model: LocalModel,
    sensing: Sensing,
    law: AffineLaw,
    cov: Float[ArrayLike, "nx nx"],
    mean: Float[ArrayLike, " nx"] | None = None,
) -> Float[ArrayLike, "T nx ny"]:
    """Return the gains of the filter that errs least under a law, of those that do not adapt.

        G = fx E[ee'] F' (F E[ee'] F' + S)^-1

    with S the second moments of the sensor's noise (Todorov 2005, Neural Comput. 17:1084). Each is
    the best for the next error's every direction.

    Arguments: as in `observed_moments`.

    Returns: the gains, (T, nx, ny).

    Raises: as in `observed_moments`.
    """
    T, nx, nu, _ = check_sensed(model, sensing)
    law, cov = _check_law(law, T, nx, nu), covariance("cov", cov, nx)
    mean = jnp.zeros_like(model.vx) if mean is None else checked("mean", mean, (nx,))
    return _gains_of(*promote((model, sensing, law, cov, mean)))


@eqx.filter_jit
def _gains_of(model, sensing, law, cov, mean):
    return _moments.carry(model, sensing, law, _moments.starting(mean, cov, mean))[1]


def observed_law(
    model: LocalModel,
    sensing: Sensing,
    gains: Float[ArrayLike, "T nx ny"],
    damping: ArrayLike = 0.0,
    *,
    bounds: tuple[ArrayLike, ArrayLike] | None = None,
) -> tuple[AffineLaw, _observed.ObservedValue]:
    """Find the best law for a filter whose estimate is unbiased, by a sweep backwards.

        k = -H^-1 g,    K = -H^-1 (G_x + G_h)                              (Li 2006, eq. 5.23-5.27)

    where H stands for the true one made positive, by its eigenvalues, and damped; the value is the
    law's own, of the true H. With bounds, k is the minimiser in the box (which thesis and paper
    approximate by clipping), and controls at bounds have no gains.

    Arguments:
        model, sensing, gains: as in `evaluate_observed`.
        damping: added to the diagonal of H, scalar or (T, nu) [cost per control unit squared].
        bounds: (lower, upper) of k, each broadcast to (T, nu).

    Returns: the law, zero where H is not positive, and its `ObservedValue`.

    Raises: ValueError for shapes that do not fit together, and for bounds that were exchanged.
    """
    T, nx, nu, ny = check_sensed(model, sensing)
    gains = checked("gains", gains, (T, nx, ny))
    box = _box(bounds, T, nu)
    return _law_of(*promote((model, sensing, gains, _damping(damping, T, nu), box)))


@eqx.filter_jit
def _law_of(model, sensing, gains, damping, bounds):
    value, chosen = _observed.best_law(symmetric(model), sensing, gains, damping, bounds)
    return chosen.law, value


def _box(bounds: tuple[ArrayLike, ArrayLike] | None, T: int, nu: int) -> Bounds | None:
    box = as_bounds(bounds, (T, nu), "bounds")
    if box is not None:
        check_bounds(*box)
    return box


def _damping(damping: ArrayLike, T: int, nu: int):
    shape = (T, nu) if jnp.ndim(damping) else ()
    return jnp.broadcast_to(checked("damping", damping, shape), (T, nu))


def observed_lqg(
    model: LocalModel,
    sensing: Sensing,
    cov: Float[ArrayLike, "nx nx"],
    mean: Float[ArrayLike, " nx"] | None = None,
    *,
    law: AffineLaw | None = None,
    damping: ArrayLike = 0.0,
    bounds: tuple[ArrayLike, ArrayLike] | None = None,
    form: str = "corrected",
    tolerance: float | None = None,
    max_steps: int = 100,
) -> ObservedLQG:
    """Minimise the expected cost of a sensed model by law and filter in turn.

    Each half of a sweep minimises exactly, so that without damping the cost never rises, and for
    what is returned neither can be improved without the other (Li 2006, section 5.4). Cost, law and
    gains have derivatives, forward and reverse, by the implicit function theorem; these are NaN
    where it did not converge, or not to the best pair that it met.

    Arguments:
        model: local expansion of plant and cost.
        sensing: local expansion of the sensor, and the estimator's own noise.
        cov: covariance of the first state, (nx, nx).
        mean: its mean, (nx,), and the first estimate; zero by default.
        law: the first law; zero by default.
        damping, bounds: as in `observed_law`; with either the cost may rise, and the best pair that
            was met is returned.
        form: with noise of the estimator's own, "published" still takes the estimate for the mean
            of the state given the estimate, and the filter that errs least for the best, and
            returns the sweeps' limit (Todorov 2005). Neither is true (Damiani et al. 2024):
            "corrected" goes on from there, and chooses both by the exact moments of state and
            estimate. As the estimate may be scaled up beside its noise, and the law down, this ends
            slowly, perhaps at `max_steps` only. Without such noise they are the same.
        tolerance: relative change of the cost in a sweep that ends them; 1e-12 by default, and
            1e-6 in float32. The law's own error is its root; a negative one asks for `max_steps`.
        max_steps: limit of the number of sweeps.

    Returns: `ObservedLQG`.

    Raises: ValueError for shapes that do not fit together, what is no covariance, exchanged bounds
        and an unknown form, naming the argument.
    """
    T, nx, nu, _ = check_sensed(model, sensing)
    check_form(form)
    cov = covariance("cov", cov, nx)
    mean = jnp.zeros_like(model.vx) if mean is None else checked("mean", mean, (nx,))
    still = AffineLaw(jnp.zeros_like(model.lu), jnp.zeros_like(model.lux))
    law = still if law is None else _check_law(law, T, nx, nu)
    problem = Observed(model, sensing, mean, cov, _damping(damping, T, nu), _box(bounds, T, nu))
    problem, law = promote((problem, law))
    if tolerance is None:
        tolerance = 1e-12 if problem.mean.dtype == jnp.float64 else 1e-6
    exact = form == "corrected" and sensing.internal is not None
    return _descend(problem, law, tolerance, max_steps, exact)


@eqx.filter_jit
def _descend(problem: Observed, law, tolerance, max_steps, exact) -> ObservedLQG:
    problem = problem._replace(model=symmetric(problem.model))
    return _coordinate_descent.coordinate_descent(problem, law, tolerance, max_steps, exact)


def sensed_lqg(
    model: LocalModel,
    *,
    law: AffineLaw | None = None,
    damping: ArrayLike = 0.0,
    tolerance: float | None = None,
    max_steps: int = 100,
) -> SensedLQG:
    """Minimise the expected cost of a problem's own model by law and filter in turn.

        sense   xhat <- xhat + G (F e + s),    e <- (I - G F) e - G s
        act     du = k + K xhat
        move    xhat <- fx xhat + fu du,       e <- fx e + n

    with e = dx - xhat the error of the estimate, s and n the noise of sensor and plant. In
    each step what is sensed tells before the control is chosen, as in `jc.simulate`;
    `observed_lqg` has Li's order, in which it tells one step late. Each half of a sweep
    minimises exactly, so that without damping the cost never rises (Li 2006, section 5.4;
    Todorov 2005). It has no reverse-mode derivative.

    Arguments:
        model: with what is sensed and the covariance of the first state, as
            `jc.expand(problem, xs, us, noise=True)` makes it of a problem with a sensor.
        law: the first one, k (T, nu) and K (T, nu, nx); zero by default.
        damping: added to the diagonal of H, scalar or (T, nu) [cost per control unit squared];
            with it the cost may rise.
        tolerance: relative change of the law in a sweep that ends them; near what rounding
            leaves by default; a negative one asks for `max_steps`.
        max_steps: limit of the number of sweeps.

    Returns: `SensedLQG`.

    Raises: ValueError for a model without what is sensed, for noise of the estimator's own or
        readings that depend on the control, which it does not know, for shapes that do not fit
        together and what is no covariance; TypeError for what is no model.
    """
    T, nx, nu = check_model(model)
    if model.sensing is None or model.x0_cov is None:
        missing = "sensing" if model.sensing is None else "x0_cov"
        raise ValueError(
            f"model.{missing}: None; jc.expand(problem, xs, us, noise=True) gives it for a problem "
            "with a sensor"
        )
    check_sensed(model, model.sensing)
    noise = model.sensing.noise
    for name, value in (
        ("E", model.sensing.E),
        ("internal", model.sensing.internal),
        ("noise.cu", None if noise is None else noise.cu),
    ):
        if value is not None:
            raise ValueError(f"model.sensing.{name}: None is wanted; `observed_lqg` takes it")
    model = model._replace(x0_cov=covariance("model.x0_cov", model.x0_cov, nx))
    still = AffineLaw(jnp.zeros_like(model.lu), jnp.zeros_like(model.lux))
    law = still if law is None else _check_law(law, T, nx, nu)
    model, law, damping = promote((model, law, _damping(damping, T, nu)))
    return _sensed_descent(model, law, damping, tolerance, max_steps)


@eqx.filter_jit
def _sensed_descent(model, law, damping, tolerance, max_steps) -> SensedLQG:
    free = jnp.zeros_like(damping)
    return _sensed.descend(symmetric(model), law, damping, free, free, max_steps, tolerance)
