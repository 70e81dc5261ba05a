"""A plant made of a plain function."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
from jaxtyping import Array, ArrayLike, Float

from ._checks import check_integer, parameter
from ._function import as_params, check_function
from ._plant import AbstractPlant
from ._types import Bounds, as_bounds


class FunctionPlant(AbstractPlant):
    """A plant made of a plain function.

    `dynamics(x, u, t)`, or `dynamics(x, u, t, params)` when `params` is given, returns the state's
    derivative, or the next state when `discrete=True`; x has shape (nx,), u has shape (nu,).
    JAX arrays in `params`, and those that the function closes over or reaches by globals, defaults
    or the object of a bound method, may change without compiling again, and gradients flow through
    them; the function gets them traced. Whatever else it depends on, Python numbers and NumPy
    arrays too, is static: when it changes, the next solve compiles again.

    Arguments:
        dynamics: the function above, or a callable pytree such as an `equinox` network.
        nx, nu: sizes of state and control, each at least 1.
        params: what `dynamics` takes last, or None: any pytree of arrays and numbers, networks
            too. Python numbers become floating arrays; integer arrays stay integers.
        discrete: whether `dynamics` returns the next state.
        control_bounds: (lower, upper), scalars or of shape (nu,), or None.
        nominal_control: where an optimisation starts, scalar or (nu,); zero by default.

    Raises ValueError or TypeError, naming the argument, when one does not fit.
    """

    dynamics: Callable
    nx: int = eqx.field(static=True)
    nu: int = eqx.field(static=True)
    params: Any = eqx.field(converter=as_params)
    discrete: bool = eqx.field(static=True)
    control_bounds: Bounds | None
    nominal_control: Float[Array, " nu"]

    def __init__(
        self,
        dynamics: Callable,
        *,
        nx: int,
        nu: int,
        params: Any = None,
        discrete: bool = False,
        control_bounds: tuple[ArrayLike, ArrayLike] | None = None,
        nominal_control: ArrayLike = 0.0,
    ):
        self.dynamics = check_function("dynamics", dynamics)
        self.nx = check_integer("nx", nx, 1)
        self.nu = check_integer("nu", nu, 1)
        self.params = as_params(params)
        self.discrete = bool(discrete)
        self.control_bounds = as_bounds(control_bounds, (self.nu,))
        self.nominal_control = parameter("nominal_control", nominal_control, (self.nu,))

    def __call__(self, x, u, t):
        """Return `dynamics(x, u, t[, params])`, shape (nx,)."""
        if self.params is None:
            return self.dynamics(x, u, t)
        return self.dynamics(x, u, t, self.params)
