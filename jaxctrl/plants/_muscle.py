"""Muscle curves: activation, active state, and tension as a function of length and velocity.

T = F0 A(a, l) (F_L(l) F_V(l, v) + F_P(l))

The curves are averages over slow and fast fibres of those of Brown, Cheng & Loeb (1999), as
Li & Todorov (2004) and Li (2006, section 3.1) use them. Length l is in units of the optimal length
L0, velocity v in L0/s (positive when the muscle lengthens), activation a is between 0 and 1, and
forces are fractions of the peak isometric force F0. All functions work elementwise.

How the active state A grows with the activation is a choice of three (`active_state`). All give
about half of F0 for full activation at l = 1: in the model of Brown, Cheng & Loeb a = 1 is the
stimulation frequency of half the maximal force. The curves hold for 0.4 <= l <= 1.9; in "brown"
full activation gives next to nothing at l = 0.6, and beyond l = 2.03, where N_f changes sign, the
tension is NaN.

Tension is once, not twice, continuously differentiable: F_L'' diverges at l = 1, F_V'' jumps at
v = 0, and the rate of activation has a kink at u = a. All derivatives returned are finite there.
"""

import functools
from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ._parameters import positive

ACTIVATION_TIME = 0.050
"""Time constant t_a of a rising activation [s] (Li & Todorov 2004)."""
DEACTIVATION_TIME = 0.066
"""Time constant t_d of a falling activation [s] (Li & Todorov 2004)."""
SPECIFIC_TENSION = 31.8
"""Peak force per cross-section [N/cm^2] (Brown, Cheng & Loeb 1999; Van Wouwe et al. 2022)."""
SMALLEST_ACTIVATION = 1e-9
"""Below it Brown's active state is flat, which keeps derivatives finite; our choice."""
FULL_ACTIVE_STATE = 0.505
"""Active state of full activation at the optimal length, A(1, 1) of Brown, Cheng & Loeb (1999)."""
Curve = Literal["linear", "brown", "brown-fixed"]
"""How the active state grows with the activation; see `active_state`."""


def activation_rate(
    a: Float[Array, "*n"],
    u: Float[Array, "*n"],
    activation_time: Array | float = ACTIVATION_TIME,
    deactivation_time: Array | float = DEACTIVATION_TIME,
) -> Float[Array, "*n"]:
    """Return the rate of change of the activation, da/dt [1/s].

    da/dt = (u - a)/t(u, a),  t = t_d + u (t_a - t_d) if u > a else t_d     (Li 2006, eq. 3.14)

    It grows strictly with u on [0, 1]; `control_of_rate` is its inverse. At u = a the derivative
    returned is that from below.

    Arguments:
        a, u: activation and control, between 0 and 1, of any one shape.
        activation_time, deactivation_time: t_a and t_d [s].
    """
    rising = deactivation_time + u * (activation_time - deactivation_time)
    return (u - a) / jnp.where(u > a, rising, deactivation_time)


def control_of_rate(
    a: Float[Array, "*n"],
    rate: Float[Array, "*n"],
    activation_time: Array | float = ACTIVATION_TIME,
    deactivation_time: Array | float = DEACTIVATION_TIME,
) -> Float[Array, "*n"]:
    """Return the control u under which the activation changes at a given rate.

    u = (a + r t_d)/(1 + r (t_d - t_a)) for r = da/dt > 0, u = a + r t_d otherwise: the exact
    inverse of `activation_rate`. u is within [0, 1] exactly when -a/t_d <= r <= (1 - a)/t_a.

    Arguments:
        a, rate: activation, and its rate of change [1/s], of any one shape.
        activation_time, deactivation_time: t_a and t_d [s].
    """
    growth = jnp.where(rate > 0, rate, 0)
    return (a + rate * deactivation_time) / (1 + growth * (deactivation_time - activation_time))


def _power(x, y):
    """Return x^y for x > 0: half the time of `x**y`, and the derivatives need no more powers."""
    return jnp.exp(y * jnp.log(x))


def as_curve(active_state: str) -> Curve:
    """Return the name of a curve; raises ValueError for another word."""
    if active_state not in get_args(Curve):
        raise ValueError(
            f"active_state: one of {list(get_args(Curve))} is wanted, got {active_state!r}"
        )
    return active_state  # pyright: ignore[reportReturnType]


def _exponent(l, curve: Curve):
    return 2.11 + 4.16 * (1 / l - 1) if curve == "brown" else jnp.full_like(l, 2.11)


def active_state(
    a: Float[Array, "*n"], l: Float[Array, "*n"], curve: Curve = "linear"
) -> Float[Array, "*n"]:
    """Return the active state A(a, l), a fraction between 0 and 1, for activation a and length l.

    "linear"        A = 0.505 a
    "brown"         A = 1 - exp(-(a/(0.56 N_f))^N_f),  N_f = 2.11 + 4.16 (1/l - 1)
    "brown-fixed"   the same with N_f = 2.11, its value at l = 1

    "brown" is the curve of Brown, Cheng & Loeb (1999), which Li & Todorov (2004) use. With the
    lengths of `MuscleArm` three of six muscles then work at exponents of 2.5 to 3.8, the price u^2
    of a force grows more slowly than the force, and optimal movements are bursts with coasting
    between them. "linear" is our choice, and the default: with it movements are smooth, as Li's
    (2006) are, and 0.505, Brown's value at a = l = 1, gives the controls and speeds on the thesis's
    axes (docs/design.md has the evidence).

    "linear" goes on below a = 0, where a muscle would push: excitations are kept from there by the
    bounds of the controls.

    Arguments:
        a, l: activation and length [L0], of any shapes that broadcast. In Brown's curves an
            activation below `SMALLEST_ACTIVATION` counts as that.
        curve: one of the three.

    Raises ValueError for another word as `curve`.
    """
    a, l = _floats(a, l)
    if as_curve(curve) == "linear":
        return FULL_ACTIVE_STATE * a
    exponent = _exponent(l, curve)
    a = jnp.where(a < SMALLEST_ACTIVATION, SMALLEST_ACTIVATION, a)  # so that NaN stays NaN
    return -jnp.expm1(-_power(a / (0.56 * exponent), exponent))


def activation_of_state(
    A: Float[Array, "*n"], l: Float[Array, "*n"], curve: Curve = "linear"
) -> Float[Array, "*n"]:
    """Return the activation a whose active state is A at length l: the inverse of `active_state`.

    "linear"    a = A/0.505;    Brown's    a = 0.56 N_f (-log(1 - A))^(1/N_f)

    a is within [0, 1] exactly when A is within [0, active_state(1, l, curve)].

    Arguments:
        A, l: active state, at least 0 and below 1, and length [L0], of any shapes that broadcast.
            NaN for lengths at which N_f is not positive, from 2.03 on.
        curve: as in `active_state`.

    Raises ValueError for another word as `curve`.
    """
    A, l = _floats(A, l)
    if as_curve(curve) == "linear":
        return A / FULL_ACTIVE_STATE
    exponent = _exponent(l, curve)
    # The slope at A = 0 is infinite; there the activation is SMALLEST_ACTIVATION and flat.
    least = active_state(jnp.full_like(l, SMALLEST_ACTIVATION), l, curve)
    rate = -jnp.log1p(-jnp.where(least >= A, least, A))
    a = jnp.where(least >= A, SMALLEST_ACTIVATION, 0.56 * exponent * _power(rate, 1 / exponent))
    return jnp.where(exponent > 0, a, jnp.nan)


def _floats(*numbers):
    dtype = jnp.result_type(*numbers, float)
    return jnp.broadcast_arrays(*(jnp.asarray(z, dtype) for z in numbers))


def force_length(l: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return the force-length factor F_L(l), without unit, for a length l > 0.

    F_L = exp(-|(l^1.93 - 1)/1.03|^1.87)        (Brown, Cheng & Loeb 1999; Li & Todorov 2004)
    """
    distance = jnp.abs((_power(l, 1.93) - 1) / 1.03)
    at_optimum = distance == 0
    power = _power(jnp.where(at_optimum, 1, distance), 1.87)
    return jnp.exp(-jnp.where(at_optimum, 0, power))


def force_velocity(l: Float[Array, "*n"], v: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return the force-velocity factor F_V(l, v), without unit; F_V(l, 0) = 1.

    F_V = (-5.72 - v)/(-5.72 + (1.38 + 2.09 l) v)                          v <= 0, shortening
    F_V = (0.62 - (-3.12 + 4.21 l - 2.67 l^2) v)/(0.62 + v)                v > 0,  lengthening

    (Li & Todorov 2004; Li 2006; the means over fibres of Brown, Cheng & Loeb 1999, except that
    theirs would be 1.335 in place of 1.38.) At v = 0 the derivative returned is that of the
    shortening branch.
    """
    lengthening = v > 0
    # Each branch sees velocities of its own sign, or its pole would turn the derivative NaN.
    slow, fast = jnp.where(lengthening, 0, v), jnp.where(lengthening, v, 0)
    shortened = (-5.72 - slow) / (-5.72 + (1.38 + 2.09 * l) * slow)
    lengthened = (0.62 - (-3.12 + 4.21 * l - 2.67 * l**2) * fast) / (0.62 + fast)
    return jnp.where(lengthening, lengthened, shortened)


def passive_force(l: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return the passive element's force F_P(l), a fraction of F0; it pushes, and so is negative.

    F_P = -0.02 exp(13.8 - 18.7 l)        (Li & Todorov 2004; Li 2006)

    Brown, Cheng & Loeb (1999) have -0.02 exp(-18.7 (l - 0.79)), that is 14.8 in place of 13.8; we
    keep the number that all versions of Li's model share. It scales with the active state. At short
    lengths it outweighs F_L: F_L + F_P is -0.04 at l = 0.55, -1.1 at 0.5, -10.6 at 0.4.
    """
    return -0.02 * jnp.exp(13.8 - 18.7 * l)


def tension(
    a: Float[Array, "*n"], l: Float[Array, "*n"], v: Float[Array, "*n"], curve: Curve = "linear"
) -> Float[Array, "*n"]:
    """Return the tension as a fraction of the peak isometric force, T/F0.

    T/F0 = A(a, l) (F_L(l) F_V(l, v) + F_P(l))        (Li & Todorov 2004; Li 2006, section 3.1)

    Arguments:
        a, l, v: activation, length [L0] and velocity [L0/s], of any shapes that broadcast.
        curve: of the active state, as in `active_state`.

    Raises ValueError for another word as `curve`.
    """
    return _tension(as_curve(curve), *_floats(a, l, v))


def _product(curve, a, l, v):
    factor = force_length(l) * force_velocity(l, v) + passive_force(l)
    return active_state(a, l, curve) * factor


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _tension(curve, a, l, v):
    return _product(curve, a, l, v)


@_tension.defjvp
def _tension_jvp(curve, primals, tangents):
    """Collect the three partial derivatives once, elementwise, before any tangent is pushed.

    The result is that of plain differentiation to all orders; a Jacobian, which pushes one tangent
    for every state and control, takes half the time on the muscle arm.
    """
    value, pull = jax.vjp(functools.partial(_product, curve), *primals)
    by_a, by_l, by_v = pull(jnp.ones_like(value))
    return value, by_a * tangents[0] + by_l * tangents[1] + by_v * tangents[2]


class Muscles(eqx.Module):
    """What m muscles pull with, and how fast they are switched on and off.

    F0 = specific tension times cross-section,  da/dt = (u - a)/t(u, a)     (Li 2006, eq. 3.14)

    Arguments:
        pcsa: physiological cross-sections [cm^2], shape (m,).
        specific_tension: peak force per cross-section [N/cm^2].
        activation_time, deactivation_time: t_a and t_d [s].
        active_state: how the force grows with the activation: "linear", "brown" or "brown-fixed";
            see the function `active_state`.

    Raises ValueError, naming the argument, for numbers that are not positive, a wrong shape, or
    another word for `active_state`.
    """

    m: int = eqx.field(static=True)
    active_state: Curve = eqx.field(static=True)
    pcsa: Float[Array, " m"]
    specific_tension: Float[Array, ""]
    activation_time: Float[Array, ""]
    deactivation_time: Float[Array, ""]

    def __init__(
        self,
        pcsa: ArrayLike,
        *,
        specific_tension: ArrayLike = SPECIFIC_TENSION,
        activation_time: ArrayLike = ACTIVATION_TIME,
        deactivation_time: ArrayLike = DEACTIVATION_TIME,
        active_state: Curve = "linear",
    ):
        if jnp.ndim(pcsa) != 1:
            raise ValueError(f"pcsa: shape {jnp.shape(pcsa)}, wanted (m,), one for each muscle")
        self.m, self.active_state = jnp.size(pcsa), as_curve(active_state)
        self.pcsa = positive("pcsa", pcsa, (self.m,))
        self.specific_tension = positive("specific_tension", specific_tension)
        self.activation_time = positive("activation_time", activation_time)
        self.deactivation_time = positive("deactivation_time", deactivation_time)

    @property
    def peak_force(self) -> Float[Array, " m"]:
        """Peak isometric forces F0 [N], shape (m,)."""
        return self.specific_tension * self.pcsa

    def tension(
        self, a: Float[Array, " m"], l: Float[Array, " m"], v: Float[Array, " m"]
    ) -> Float[Array, " m"]:
        """Return the tensions T [N], shape (m,), for activation, length [L0] and velocity [L0/s].

        Each of shape (m,); see the function `tension`.
        """
        return self.peak_force * tension(a, l, v, self.active_state)

    def activation_rate(self, a: Float[Array, " m"], u: Float[Array, " m"]) -> Float[Array, " m"]:
        """Return da/dt [1/s], shape (m,), for activations and excitations between 0 and 1, (m,)."""
        return activation_rate(a, u, self.activation_time, self.deactivation_time)
