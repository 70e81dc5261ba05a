"""Run a controller on a plant, with or without noise: the only closed-loop scan."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ._controller import AbstractController, AffinePolicy, OpenLoop
from ._jit import jit
from ._noise import AbstractNoise
from ._plant import AbstractPlant
from ._problem import Problem, check_x0
from ._types import promote


class Trajectory(eqx.Module):
    """What happened: times ts (T+1,) [s], states xs (T+1, nx), controls us (T, nu), costs (T+1,).

    `costs` holds the cost of each step and of the last state; `cost` is their sum.
    """

    ts: Float[Array, " T+1"]
    xs: Float[Array, "T+1 nx"]
    us: Float[Array, "T nu"]
    costs: Float[Array, " T+1"]

    @property
    def cost(self) -> Float[Array, ""]:
        """The total cost, shape ()."""
        return self.costs.sum(-1)


def simulate(
    problem: Problem,
    controller: AbstractController,
    x0: ArrayLike,
    *,
    key: Array | None = None,
    plant: AbstractPlant | None = None,
    noise: AbstractNoise | None = None,
) -> Trajectory:
    """Run a controller from x0 for the problem's duration.

    dx = f(x, u, t) dt + F(x, u, t) dw, by the problem's integrator plus sqrt(dt) F xi (Euler and
    Maruyama, in the sense of Ito); for a discrete plant x' = f(x, u, t) + F xi. Trials are made by
    `jax.vmap` over keys.

    Arguments:
        problem: grid, plant, cost and noise. Its arrays, the controller's and x0 are promoted to
            one floating dtype, the widest among them.
        controller: what acts, such as `solution.policy` or `OpenLoop(us)`.
        x0: true starting state, shape (nx,).
        key: a `jax.random.key`; without one nothing is random and the problem's noise is off.
        plant, noise: what really moves and disturbs, where that differs from the problem's.

    Returns: `Trajectory`; its costs are the problem's, for the plant that really moved.

    Raises: ValueError or TypeError, naming the argument, when x0 or key do not fit, or when
    `noise` is given without a key.
    """
    if not isinstance(controller, AbstractController):
        raise TypeError(
            f"controller: solution.policy or a controller is wanted, got {type(controller)}"
        )
    x0 = check_x0(problem, x0)
    if plant is not None:
        if not isinstance(plant, AbstractPlant):
            raise TypeError(
                f"plant: a plant is wanted, such as InField(arm, Curl()), got {plant!r}"
            )
        if (plant.nx, plant.nu) != (problem.plant.nx, problem.plant.nu):
            raise ValueError(
                f"plant: {plant.nx} states and {plant.nu} controls, wanted "
                f"{problem.plant.nx} and {problem.plant.nu}"
            )
        problem = eqx.tree_at(lambda p: p.plant, problem, plant)
    if noise is not None and key is None:
        raise ValueError("key: wanted together with `noise`, got None")
    noise = problem.noise if noise is None else noise
    if key is not None:
        _check_key(key)
        if noise is None and isinstance(controller, AffinePolicy | OpenLoop):
            warnings.warn(
                "key: given, but nothing is random: neither the problem nor this call has `noise`",
                stacklevel=2,
            )
    problem, controller, x0, noise = promote((problem, controller, x0, noise))
    return _run(problem, controller, x0, key, noise)


def _check_key(key) -> None:
    typed = isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    old = hasattr(key, "dtype") and key.dtype == jnp.uint32 and key.ndim >= 1
    if not typed and not old:
        raise TypeError(f"key: a jax.random.key(seed) is wanted, got {key!r}")
    shape = key.shape if typed else key.shape[:-1]
    if shape != ():
        raise ValueError(f"key: got {shape} keys, wanted one; many trials go through jax.vmap")


@jit
def _run(problem: Problem, controller, x0, key, noise) -> Trajectory:
    num_steps, scale = problem.num_steps, jnp.sqrt(problem.rate)
    if key is None:
        start_key, keys = None, None
    else:
        start_key, steps_key = jax.random.split(key)
        keys = jax.random.split(steps_key, num_steps)

    def body(carry, inputs):
        x, memory = carry
        k, t, key = inputs
        noise_key, control_key = (None, None) if key is None else jax.random.split(key)
        memory, u = controller.step(memory, x, k, control_key)
        after = problem.step(x, u, t)
        if noise is not None and noise_key is not None:
            F = noise(problem.plant, x, u, t)
            xi = jax.random.normal(noise_key, F.shape[1:], F.dtype)
            after = after + scale * F @ xi
        return (after, memory), (after, u)

    carry = (x0, controller.init(x0, start_key))
    inputs = (jnp.arange(num_steps), problem.ts[:-1], keys)
    _, (xs, us) = jax.lax.scan(body, carry, inputs)
    xs = jnp.concatenate([x0[None], xs])
    return Trajectory(problem.ts, xs, us, problem.stage_costs(xs, us))
