"""Pontryagin's conditions of a continuous-time problem: the Hamiltonian, and what minimises it.

    H(x, u, p, t) = l(x, u, t) + p'f(x, u, t) + (u - u_n)'W (u - u_n)/2,     u* = argmin_u H
    dx/dt = f(x, u*, t),     dp/dt = -dH/dx,     x(0) = x_0,     p(T) = dh/dx(x(T))

over controls within their bounds (Pontryagin et al. 1962). W >= 0, a diagonal, is zero in the
problem itself; continuation starts from a large one, at which the nominal control u_n is nearly
optimal.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._jacobian import dependence, gradient, jacobian
from .._linalg import solve_positive
from .._plant import nominal_control
from .._problem import Problem
from ..linear._boxqp import box_qp

LEVELS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Where between its bounds each control starts when H is minimised by Newton's method."""
MAX_STEPS = 30
HALVINGS = 12
SMALL_DECREMENT = 1e4
"""The largest g'H_uu^-1 g/2 at a minimiser, in eps of |l| + sum_i |p_i f_i|."""


class Hamiltonian(eqx.Module):
    """The Hamiltonian of a problem, and its canonical equations in y = (x, p), shape (2 nx,).

    Attributes:
        problem: a continuous-time problem without events.
        price: the diagonal of W, shape (nu,).
    """

    problem: Problem
    price: Float[Array, " nu"]

    def value(
        self, x: Float[Array, " nx"], u: Float[Array, " nu"], p: Float[Array, " nx"], t: Array
    ) -> Float[Array, ""]:
        """Return H, shape (), at a state x and costate p (nx,), under u (nu,), at time t [s]."""
        plant = self.problem.plant
        extra = 0.5 * jnp.sum(self.price * (u - plant.nominal_control) ** 2)
        return self.problem.running(x, u, t) + extra + jnp.sum(p * plant(x, u, t))

    def bounds(self, t: Array) -> tuple[Float[Array, " nu"], Float[Array, " nu"]]:
        """Return the bounds in the step in which t [s] lies, (nu,) each; infinite without any."""
        bounds, nu = self.problem.bounds, self.problem.plant.nu
        if bounds is None:
            infinite = jnp.full((nu,), jnp.inf, self.price.dtype)
            return -infinite, infinite
        k = jnp.clip(jnp.floor(t / self.problem.dt), 0, self.problem.num_steps - 1).astype(int)
        return bounds[0][k], bounds[1][k]

    def minimiser(
        self, x: Float[Array, " nx"], p: Float[Array, " nx"], t: Array
    ) -> tuple[Float[Array, " nu"], Bool[Array, ""]]:
        """Minimise H over the controls within their bounds.

        Where H is quadratic in u, as for control-affine plants, by one quadratic program. Else by
        projected Newton steps from several starts between the bounds (from the nominal control
        where there are none), whose ends are then combined control by control, keeping what lowers
        H: the global minimum, then, if H is a sum over the controls and the starts find the minima
        of each. The excitation of a muscle is such a control: da/dt has a kink at u = a, with a
        minimum on either side.

        Arguments: x, p of shape (nx,), t [s].

        Returns: u (nu,), with its implicit derivatives in x and p, and whether H has a strict
        minimum there.
        """
        x_, p_ = jax.lax.stop_gradient((x, p))
        lower, upper = self.bounds(t)
        rows = self._moved_rows(x_, t)

        def value(u):
            return self._moved_value(rows, u, x_, p_, t)

        nominal = nominal_control(self.problem.plant).astype(lower.dtype)
        u, certain = _minimise(value, nominal, lower, upper)
        # One more step, of length zero but for its derivative.
        u = jax.lax.stop_gradient(_onto(u, lower, upper))
        slope = gradient(lambda u, x, p, t: self._moved_value(rows, u, x, p, t))(u, x, p, t)
        fixed = jax.lax.stop_gradient(slope)
        free = ~(((u <= lower) & (fixed > 0)) | ((u >= upper) & (fixed < 0)))
        H = jax.jacfwd(gradient(value))(u)
        H = jnp.where(free[:, None] & free, H, jnp.eye(u.size, dtype=u.dtype))
        solved, positive = solve_positive(H, jnp.where(free, slope, 0.0)[:, None])
        step = solved[:, 0]
        plant = self.problem.plant
        size = jnp.abs(self.problem.running(x_, u, t)) + jnp.sum(jnp.abs(p_ * plant(x_, u, t)))
        decrement = 0.5 * jnp.sum(step * jnp.where(free, fixed, 0.0))
        small = decrement <= SMALL_DECREMENT * jnp.finfo(u.dtype).eps * size
        return u - step, jax.lax.stop_gradient(positive & small & certain)

    def _moved_rows(self, x, t) -> list[int]:
        """Return which rates of the state depend on the controls."""
        pattern = dependence(lambda u, x, t: self.problem.plant(x, u, t), self.price, x, t)
        return np.flatnonzero(pattern.any(axis=1)).tolist()

    def _moved_value(self, rows: list[int], u, x, p, t):
        """Return H less what does not depend on the controls, which is most of an arm."""
        plant = self.problem.plant
        extra = 0.5 * jnp.sum(self.price * (u - plant.nominal_control) ** 2)
        rates = plant(x, u, t)
        # Slices one by one: XLA sees through them, and drops the other rates.
        moved = sum((p[i] * rates[i] for i in rows), jnp.zeros((), u.dtype))
        return self.problem.running(x, u, t) + extra + moved

    def rates(self, t: Array, y: Float[Array, " 2*nx"]) -> Float[Array, " 2*nx"]:
        """Return dy/dt = (f, -dH/dx), shape (2 nx,), with u = u*, at y = (x, p) and t [s]."""
        x, p = jnp.split(y, 2)
        u, _ = self.minimiser(x, p, t)
        slope = gradient(self.value)(x, u, p, t)
        return jnp.concatenate([self.problem.plant(x, u, t), -slope])

    def final_slope(self, x: Float[Array, " nx"]) -> Float[Array, " nx"]:
        """Return dh/dx, shape (nx,), at the last state x (nx,)."""
        return gradient(self.problem.end)(x)


def _onto(u, lower, upper):
    """Put on its bound what rounding left a few units inside it."""
    eps = 4 * jnp.finfo(u.dtype).eps
    u = jnp.where(u <= lower + eps * jnp.abs(lower), lower, u)
    return jnp.where(u >= upper - eps * jnp.abs(upper), upper, u)


def _minimise(value, nominal, lower, upper):
    """Minimise a function of the controls in a box.

    Returns: the minimiser (nu,), and False where a quadratic program on the way to it is known not
    to have been solved; of a function that is not quadratic, only the end can tell.
    """
    slope = gradient(value)
    # Known from the operations alone, whatever the numbers.
    curvature = jacobian(slope, symmetric=True)
    quadratic = not dependence(curvature, nominal).any()
    pattern = dependence(slope, nominal)
    separable = not (pattern & ~np.eye(len(pattern), dtype=bool)).any()

    def model(u):
        g, H = slope(u), curvature(u)
        if separable:
            h = jnp.diagonal(H)
            size = jnp.where(h != 0, jnp.abs(h), 1.0)
            return jnp.clip(u - g / size, lower, upper) - u, (h >= 0).all()
        _, positive = solve_positive(H, g[:, None])
        bound = jnp.diag(jnp.sum(jnp.abs(H), axis=1) + jnp.finfo(u.dtype).tiny)
        program = box_qp(jnp.where(positive, H, bound), g, lower - u, upper - u)
        return program.x, positive & program.finished

    if quadratic:
        u = jnp.clip(nominal, lower, upper)
        step, certain = model(u)
        return jnp.clip(u + step, lower, upper), certain
    u = _from_several(value, lambda u: model(u)[0], nominal, lower, upper)
    return u, jnp.array(True)


def _from_several(value, model, nominal, lower, upper):
    """Descend from several starts, and combine the ends control by control."""
    boxed = jnp.isfinite(upper - lower)
    low = jnp.where(boxed, lower, jnp.clip(nominal, lower, upper))
    width = jnp.where(boxed, upper - lower, 0.0)
    starts = low + jnp.asarray(LEVELS, low.dtype)[:, None] * width
    ends, values = jax.vmap(lambda u: _descend(value, model, u, lower, upper))(starts)

    def choose(i, u):
        trials = jnp.where(jnp.arange(u.size) == i, ends, u)
        values = jax.vmap(value)(trials)
        best = jnp.nanargmin(values)
        return jnp.where(values[best] < value(u), trials[best], u)

    u = jax.lax.fori_loop(0, nominal.size, choose, ends[jnp.nanargmin(values)])
    return _descend(value, model, u, lower, upper)[0]


def _descend(value, model, start, lower, upper):
    """Take the model's steps, shortened, until they lower the value no more."""
    fractions = 0.5 ** jnp.arange(HALVINGS, dtype=start.dtype)

    def body(carry):
        u, least, _, count = carry
        trials = jnp.clip(u + fractions[:, None] * model(u), lower, upper)
        values = jax.vmap(value)(trials)
        best = jnp.argmin(jnp.where(jnp.isnan(values), jnp.inf, values))
        falls = values[best] < least
        u, least = jnp.where(falls, trials[best], u), jnp.where(falls, values[best], least)
        return u, least, ~falls, count + 1

    def unfinished(carry):
        _, _, done, count = carry
        return ~done & (count < MAX_STEPS)

    carry = (start, value(start), jnp.array(False), jnp.array(0))
    u, least, _, _ = jax.lax.while_loop(unfinished, body, carry)
    return u, least
