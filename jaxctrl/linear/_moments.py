"""Means and covariances of states and estimates, carried forward exactly, and the filter's gains.

The error e = dx - xhat and the estimate xhat of `Sensing` obey, under du = k + K xhat,

    e'    = (f_x - G F) e + p - G s - i
    xhat' = (f_x + f_u K) xhat + f_u k + G F e + G s + i

with p, s and i the noise of plant, sensor and estimator: sums of columns that depend on dx and du,
whose second moments P, S and I follow from those of e and xhat. All is linear, so that two moments
are enough whatever the distributions. The error's own coordinates lose no digits where it is small.

The gain G = f_x E[ee'] F' (F E[ee'] F' + S)^-1 makes E[ee'] of the next step the least that it can
be (Todorov 2005, Neural Comput. 17:1084, with noise in the state and the control too).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._linalg import solve_semidefinite, symmetrise
from .._types import LocalModel, Noise, Sensing, Stages
from ._step import columns


class AffineLaw(NamedTuple):
    """A law du = k + K xhat of an estimate of the state."""

    k: Float[Array, "T nu"]
    K: Float[Array, "T nu nx"]


class Joint(NamedTuple):
    """Mean (2 nx,) and covariance (2 nx, 2 nx) of the error and the estimate, one above the other.

    Both may lead with time.
    """

    mean: Float[Array, "*T 2nx"]
    cov: Float[Array, "*T 2nx 2nx"]


class Moments(NamedTuple):
    """Means and covariances of errors e = dx - xhat, estimates xhat and controls under a law.

    `cov_cross` is that of e with xhat, zero where the estimate is the best linear one. `cost` is
    the expected cost, the model's constant left out.
    """

    mean_error: Float[Array, "T+1 nx"]
    mean_estimate: Float[Array, "T+1 nx"]
    mean_u: Float[Array, "T nu"]
    cov_error: Float[Array, "T+1 nx nx"]
    cov_estimate: Float[Array, "T+1 nx nx"]
    cov_cross: Float[Array, "T+1 nx nx"]
    cov_u: Float[Array, "T nu nu"]
    cost: Float[Array, ""]

    @property
    def mean_x(self) -> Float[Array, "T+1 nx"]:
        """Mean of the states, (T+1, nx)."""
        return self.mean_error + self.mean_estimate

    @property
    def cov_x(self) -> Float[Array, "T+1 nx nx"]:
        """Covariance of the states, (T+1, nx, nx)."""
        return self.cov_error + self.cov_estimate + self.cov_cross + self.cov_cross.mT


def starting(mean: Array, cov: Array, estimate: Array) -> Joint:
    """Return the moments of a start of mean (nx,), cov (nx, nx) and a fixed estimate (nx,)."""
    nx = mean.shape[0]
    return Joint(jnp.concatenate([mean - estimate, estimate]), jnp.pad(cov, ((0, nx), (0, nx))))


def second(cov: Array, mean: Array) -> Array:
    """Return E[aa'] (n, n) of a covariance (n, n) and a mean (n,)."""
    return cov + mean[:, None] * mean


def sensed_noise(joint: Joint, sense: Sensing, law: AffineLaw) -> Float[Array, "ny ny"]:
    """Return S, the second moments of the sensor's noise at one step."""
    return _spread(joint, sense.noise, law, sense.F.shape[0])


def _spread(joint: Joint, noise: Noise | None, law: AffineLaw, size: int) -> Array:
    """Return sum_i E[(c_i + cx_i dx + cu_i du)(...)'], (size, size), of one step."""
    if noise is None:
        return jnp.zeros((size, size), joint.mean.dtype)
    nu, nx = law.K.shape
    c, cx, cu = columns(noise, nx, nu)
    slope = jnp.concatenate([cx, cx + cu @ law.K], axis=2)
    level = c + cu @ law.k + slope @ joint.mean
    return level.T @ level + jnp.sum(slope @ joint.cov @ slope.mT, axis=0)


def error_gain(joint: Joint, stage: Stages, sense: Sensing, law: AffineLaw) -> Array:
    """Return the gain (nx, ny) that makes the next error the least, of one step."""
    nx = stage.fx.shape[0]
    error = second(joint.cov[:nx, :nx], joint.mean[:nx])
    FE = sense.F @ error
    innovation = FE @ sense.F.T + sensed_noise(joint, sense, law)
    return solve_semidefinite(symmetrise(innovation), FE @ stage.fx.T).T


def step_moments(joint: Joint, stage: Stages, sense: Sensing, law: AffineLaw, gain: Array) -> Joint:
    """Return the moments one step later, for the law and the gain (nx, ny) of the step."""
    A, B, GF = stage.fx, stage.fu, gain @ sense.F
    nx = A.shape[0]
    move = jnp.block([[A - GF, jnp.zeros_like(A)], [GF, A + B @ law.K]])
    pushed = jnp.concatenate([jnp.zeros(nx, A.dtype), B @ law.k])
    plant = _spread(joint, stage.noise, law, nx)
    told = gain @ sensed_noise(joint, sense, law) @ gain.T
    if sense.internal is not None:
        told = told + sense.internal.T @ sense.internal
    added = jnp.block([[plant + told, -told], [-told, told]])
    return Joint(move @ joint.mean + pushed, symmetrise(move @ joint.cov @ move.T + added))


def carry(
    model: LocalModel,
    sensing: Sensing,
    law: AffineLaw,
    start: Joint,
    gains: Float[Array, "T nx ny"] | None = None,
) -> tuple[Joint, Float[Array, "T nx ny"]]:
    """Carry the moments forward, with the gains given or, without, the ones of `error_gain`.

    Returns: the moments at T+1 times, and the gains.
    """

    def forth(joint, inputs):
        stage, sense, law, gain = inputs
        gain = error_gain(joint, stage, sense, law) if gain is None else gain
        return step_moments(joint, stage, sense, law, gain), (joint, gain)

    end, (joints, gains) = jax.lax.scan(forth, start, (model.stages, sensing, law, gains))
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), joints, end), gains


def expected(model: LocalModel, law: AffineLaw, joints: Joint) -> Float[Array, ""]:
    """Return the expected cost of a law from the moments at T+1 times."""
    nx = model.vx.size
    both = jnp.tile(jnp.eye(nx, dtype=model.vx.dtype), 2)
    mean_x = joints.mean @ both.T
    cov_x = both @ joints.cov @ both.T
    mean_u = law.k + jnp.einsum("tux,tx->tu", law.K, joints.mean[:-1, nx:])
    cov_ux = law.K @ joints.cov[:-1, nx:] @ both.T
    cov_u = law.K @ joints.cov[:-1, nx:, nx:] @ law.K.mT

    def weigh(x, xx, u, ux, uu, lx, lu, lxx, lux, luu):
        linear = lx @ x + lu @ u + u @ lux @ x + jnp.sum(lux * ux)
        return linear + 0.5 * (x @ lxx @ x + u @ luu @ u + jnp.sum(lxx * xx) + jnp.sum(luu * uu))

    cost = (model.lx, model.lu, model.lxx, model.lux, model.luu)
    steps = jax.vmap(weigh)(mean_x[:-1], cov_x[:-1], mean_u, cov_ux, cov_u, *cost)
    if model.noise is not None and model.noise.weight is not None:
        past = jax.tree.map(lambda a: a[:-1], joints)
        noise = jax.vmap(lambda j, n, law: _spread(j, n, law, nx))(past, model.noise, law)
        steps = steps + 0.5 * jnp.sum(model.noise.weight * noise, axis=(1, 2))
    x, xx = mean_x[-1], cov_x[-1]
    last = model.vx @ x + 0.5 * (x @ model.vxx @ x + jnp.sum(model.vxx * xx))
    return jnp.sum(steps) + last


def moments(
    model: LocalModel,
    sensing: Sensing,
    law: AffineLaw,
    gains: Float[Array, "T nx ny"],
    start: Joint,
) -> Moments:
    """Return the moments of states, estimates and controls, and the expected cost."""
    nx = model.vx.size
    joints, _ = carry(model, sensing, law, start, gains)
    mean, cov = joints
    return Moments(
        mean[:, :nx],
        mean[:, nx:],
        law.k + jnp.einsum("tux,tx->tu", law.K, mean[:-1, nx:]),
        cov[:, :nx, :nx],
        cov[:, nx:, nx:],
        cov[:, :nx, nx:],
        law.K @ cov[:-1, nx:, nx:] @ law.K.mT,
        expected(model, law, joints),
    )
