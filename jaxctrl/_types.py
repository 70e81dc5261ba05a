"""Types that every floor shares: array leaves, bounds, and the local linear-quadratic model."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

Bounds = tuple[Array, Array]


def array_leaf(value: ArrayLike, name: str = "") -> Array:
    """Return `value` (any shape) as a floating array of that shape: a leaf that has a gradient.

    A number of your own plant or cost becomes one by `eqx.field(converter=jc.array_leaf)`. Python
    numbers and integers take JAX's default float type of the moment; floating arrays keep theirs.
    Raises TypeError, naming the argument if `name` is given, for what is no real number, for ragged
    lists, and for floats too coarse to optimise with, such as float16.
    """
    label = f"{name}: " if name else ""
    text = isinstance(value, str | bytes)  # NumPy would read b"1" as a number
    try:
        array = jnp.asarray(None if text else value)
    except (TypeError, ValueError):
        array = None
    if array is None or value is None or text:
        raise TypeError(f"{label}a real number or an array is wanted, got {value!r}") from None
    if array.dtype in (jnp.float32, jnp.float64):
        # With its dtype given the array is not weakly typed, which would compile a second time.
        return jnp.asarray(array, array.dtype)
    if jnp.issubdtype(array.dtype, jnp.integer) or array.dtype == jnp.bool_:
        return array.astype(jnp.result_type(float))
    coarse = jnp.issubdtype(array.dtype, jnp.floating)
    hint = "; that is too coarse for an optimisation, use float32 or float64" if coarse else ""
    raise TypeError(f"{label}a real number or an array is wanted, got dtype {array.dtype}{hint}")


def leaf(name: str) -> Callable[[ArrayLike], Array]:
    """Return `array_leaf` with the name of a field, as its converter."""
    return lambda value: array_leaf(value, name)


def as_bounds(
    bounds: tuple[ArrayLike, ArrayLike] | None, shape: tuple[int, ...], name: str = "control_bounds"
) -> Bounds | None:
    """Return (lower, upper) broadcast to `shape`, or None.

    Raises ValueError when `bounds` is not a pair or does not broadcast to `shape`, TypeError for
    what is no number.
    """
    if bounds is None:
        return None
    if not isinstance(bounds, tuple | list) or len(bounds) != 2:
        raise ValueError(f"{name}: a pair (lower, upper) is wanted, got {bounds!r}")
    pair = []
    for which, bound in zip(("lower", "upper"), bounds, strict=True):
        array = array_leaf(bound, f"{name}: the {which} bound")
        try:
            pair.append(jnp.broadcast_to(array, shape))
        except ValueError:
            raise ValueError(
                f"{name}: the {which} bound has shape {array.shape}, wanted () or {shape}"
            ) from None
    return (pair[0], pair[1])


def clip(u: Array, bounds: Bounds | None) -> Array:
    """Return u clipped to (lower, upper), which broadcast against u, or u when there are none."""
    if bounds is None:
        return u
    return jnp.clip(u, bounds[0], bounds[1])


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Rows:
    """Which rows of each column may have a slope: `of[i]` lists those of column i, r for each."""

    of: tuple[tuple[int, ...], ...]

    @property
    def index(self) -> np.ndarray:
        """The rows as an array, (nw, r)."""
        return np.array(self.of)

    def onehot(self, nx: int, dtype: Any) -> np.ndarray:
        """Return the matrices S_i with S_i x = x[of[i]], shape (nw, r, nx)."""
        return np.equal(self.index[:, :, None], np.arange(nx)).astype(dtype)


class Noise(NamedTuple):
    """What disturbs each step of a local model: sum_i (c_i + cx_i dx + cu_i du) xi_i.

    The xi_i are independent with mean 0 and variance 1; c_i holds the square root of the time step.
    `cx` and `cu` are None where they vanish, as for additive noise. With `rows` they have only the
    r rows of each column that are named there (a muscle's noise has a slope in its own activation
    alone), where otherwise r = nx. `weight` W is what the noise w of a step costs within that step,
    w'W w/2 beside what V_xx after it makes of it: of an event between two states, of a residual of
    the state after; None for none.
    """

    c: Float[Array, "T nw nx"]
    cx: Float[Array, "T nw r nx"] | None = None
    cu: Float[Array, "T nw r nu"] | None = None
    rows: Rows | None = None
    weight: Float[Array, "T nx nx"] | None = None


class Stages(NamedTuple):
    """The steps of a `LocalModel`, each array leading with time: what a sweep scans over.

    Their noise is the model's, or what a sweep makes of it; None for none.
    """

    fx: Float[Array, "T nx nx"]
    fu: Float[Array, "T nx nu"]
    lx: Float[Array, "T nx"]
    lu: Float[Array, "T nu"]
    lxx: Float[Array, "T nx nx"]
    lux: Float[Array, "T nu nx"]
    luu: Float[Array, "T nu nu"]
    noise: Any


class LocalModel(NamedTuple):
    """Linear-quadratic expansion of a problem along a trajectory of T steps.

    dx' = fx dx + fu du (+ noise) for each step, and for the cost of each step
    l + lx' dx + lu' du + (dx' lxx dx + 2 du' lux dx + du' luu du) / 2, and at the end
    vx' dx + dx' vxx dx / 2. Every array but vx and vxx leads with time. The cost's blocks hold
    the time step already; for an exact second-order expansion they hold the costates contracted
    with the second derivatives of the dynamics too. Of lxx, luu and vxx only the symmetric parts
    count. Without `noise` nothing is computed for it. `sensing`, if any, says what is sensed,
    and `x0_cov` how uncertain the first state is.
    """

    fx: Float[Array, "T nx nx"]
    fu: Float[Array, "T nx nu"]
    lx: Float[Array, "T nx"]
    lu: Float[Array, "T nu"]
    lxx: Float[Array, "T nx nx"]
    lux: Float[Array, "T nu nx"]
    luu: Float[Array, "T nu nu"]
    vx: Float[Array, " nx"]
    vxx: Float[Array, "nx nx"]
    noise: Noise | None = None
    sensing: "Sensing | None" = None
    x0_cov: Float[Array, "nx nx"] | None = None

    @property
    def stages(self) -> Stages:
        """What belongs to the steps, every array leading with time."""
        return Stages(self.fx, self.fu, self.lx, self.lu, self.lxx, self.lux, self.luu, self.noise)


class Sensing(NamedTuple):
    """What is sensed at each step of a local model, and how noisy it and the estimate are.

        y = F dx + E du + sum_j (d_j + D^x_j dx + D^u_j du) eta_j         (Li 2006, eq. 5.4-5.13)

    A filter with gains G makes of it the estimate of the next state,

        xhat' = fx xhat + fu du + G (y - F xhat - E du) + sum_m i_m omega_m.

    The eta_j and omega_m are independent with mean 0 and variance 1. `noise` holds d, D^x and D^u,
    with ny rows where that of a plant has nx, and the i_m are `internal`, the estimator's own noise
    (Todorov 2005). Every array leads with time; None stands for what vanishes. E cancels in what
    the filter learns, and so in every cost.
    """

    F: Float[Array, "T ny nx"]
    E: Float[Array, "T ny nu"] | None = None
    noise: Noise | None = None
    internal: Float[Array, "T ni nx"] | None = None


def promote(tree):
    """Promote every floating array of a pytree to the widest dtype among them."""
    arrays = [leaf for leaf in jax.tree.leaves(tree) if eqx.is_inexact_array(leaf)]
    dtype = jnp.result_type(*arrays)
    if all(array.dtype == dtype for array in arrays):
        return tree
    return jax.tree.map(
        lambda leaf: leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf, tree
    )
