"""One step of the cost-to-go of a plant that is only sensed, for any affine law and any filter.

With du = k + K xhat, and G the gain of the filter of `Sensing`, the expected cost from a step on is

    v(dx, xhat) = v + v_x'dx + v_h'xhat + dx'V_xx dx/2 + xhat'V_hh xhat/2 + dx'V_xh xhat.

Before du is chosen, what it costs is du'(g + G_x dx + G_h xhat) + du'H du/2, with

    H   = l_uu + f_u'(V_xx + V_hh + V_xh + V_xh') f_u              (+ noise)
    g   = l_u + f_u'(v_x + v_h)                                    (+ noise)
    G_x = l_ux + f_u'(V_xx + V_xh') f_x + f_u'(V_hh + V_xh) G F    (+ noise)
    G_h = f_u'(V_hh + V_xh) (f_x - G F)

where V_xx weighs the plant's columns of noise and V_hh those of the sensor, times G, and the
estimator's own.

Li (2006), eq. 5.16-5.26, whose 2 V_xh has to be V_xh + V_xh' in (5.17) and (5.23), and whose V_xh
in f_u'V_xh f_x of (5.25) has to be V_xh': as printed they hold for the best law alone, for which
V_xh is symmetric. S^x, S^xhat and S^x,xhat there are V_xx, V_hh and V_xh here; L is K, K is G.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._linalg import symmetrise
from .._types import Noise, Sensing, Stages
from ._step import Action, columns, disturbed, pack


class ObservedValue(NamedTuple):
    """The expected cost from a state and its estimate on.

    It is v + vx'dx + vh'xhat + dx'vxx dx/2 + xhat'vhh xhat/2 + dx'vxh xhat; `at` adds it up.
    """

    v: Float[Array, ""]
    vx: Float[Array, " nx"]
    vh: Float[Array, " nx"]
    vxx: Float[Array, "nx nx"]
    vhh: Float[Array, "nx nx"]
    vxh: Float[Array, "nx nx"]

    def at(self, dx: Float[Array, " nx"], xhat: Float[Array, " nx"]) -> Float[Array, ""]:
        """Return the expected cost from the state dx (nx,) and the estimate xhat (nx,)."""
        linear = self.v + self.vx @ dx + self.vh @ xhat + dx @ self.vxh @ xhat
        return linear + 0.5 * (dx @ self.vxx @ dx + xhat @ self.vhh @ xhat)


class ObservedAction(NamedTuple):
    """The cost of a step and of what follows it: `rest`, what it is for du = 0, and H, g, Gx and Gh
    of the module's equations."""

    rest: ObservedValue
    H: Float[Array, "nu nu"]
    g: Float[Array, " nu"]
    Gx: Float[Array, "nu nx"]
    Gh: Float[Array, "nu nx"]


def observed_action(
    ahead: ObservedValue, stage: Stages, sense: Sensing, gain: Float[Array, "nx ny"]
) -> ObservedAction:
    """Return the cost of one step and of what follows it (the module's equations).

    Arguments: the value ahead, the step's slices of the model and of the sensing, and the filter's
    gain (nx, ny).
    """
    A, B, GF = stage.fx, stage.fu, gain @ sense.F
    closed = A - GF
    v, vx, vh, vxx, vhh, vxh = ahead
    noise = _noise(ahead, stage, sense, gain)
    across = A.T @ vxh @ GF
    rest = ObservedValue(
        v + noise.q,
        stage.lx + A.T @ vx + GF.T @ vh + noise.x,
        closed.T @ vh,
        stage.lxx + A.T @ vxx @ A + GF.T @ vhh @ GF + across + across.T + noise.xx,
        closed.T @ vhh @ closed,
        (GF.T @ vhh + A.T @ vxh) @ closed,
    )
    seen = B.T @ (vhh + vxh)
    both = B.T @ (vxx + vxh.T)
    return ObservedAction(
        rest,
        symmetrise(stage.luu + (both + seen) @ B + noise.uu),
        stage.lu + B.T @ (vx + vh) + noise.u,
        stage.lux + both @ A + seen @ GF + noise.ux,
        seen @ closed,
    )


def _noise(ahead: ObservedValue, stage: Stages, sense: Sensing, gain: Array) -> Action:
    """Return what all the noise of a step adds, in the state and the control."""
    nx, nu = shape = stage.fu.shape
    zero = (jnp.zeros(s, gain.dtype) for s in ((), (nx,), (nu,), (nx, nx), (nu, nx), (nu, nu)))
    total, parts = Action(*zero), []
    if stage.noise is not None:
        parts.append(disturbed(pack(stage.noise, shape), ahead.vxx, shape))
    if sense.noise is not None:
        parts.append(disturbed(pack(_through(gain, sense.noise, shape), shape), ahead.vhh, shape))
    if sense.internal is not None:
        parts.append(disturbed(pack(Noise(sense.internal), shape), ahead.vhh, shape))
    for part in parts:
        total = Action(*(a + b for a, b in zip(total, part, strict=True)))
    return total


def _through(gain: Array, noise: Noise, shape: tuple[int, ...]) -> Noise:
    """Return the columns that the sensor's noise has in the estimate, the gain times its own."""
    c, cx, cu = columns(noise, *shape)
    return Noise(c @ gain.T, gain @ cx, gain @ cu)


def observed_value(
    Q: ObservedAction, k: Float[Array, " nu"], K: Float[Array, "nu nx"]
) -> ObservedValue:
    """Return the value before a step under the law du = k + K xhat, k (nu,) and K (nu, nx).

    H here is the true one, whatever was done to it to choose the law.
    """
    v, vx, vh, vxx, vhh, vxh = Q.rest
    after = Q.g + Q.H @ k
    return ObservedValue(
        v + 0.5 * k @ (Q.g + after),
        vx + Q.Gx.T @ k,
        vh + K.T @ after + Q.Gh.T @ k,
        symmetrise(vxx),
        symmetrise(vhh + K.T @ (Q.H @ K + 2 * Q.Gh)),
        vxh + Q.Gx.T @ K,
    )
