"""Run a controller on a plant, with or without noise: the only closed-loop scan."""

import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ._checks import check_again, converted, is_concrete
from ._controller import AbstractController, AffinePolicy, OpenLoop
from ._delay import shifted, told, unchanged
from ._function import closed
from ._jit import jit
from ._linalg import is_covariance, matmul, root
from ._noise import AbstractNoise, diffusion
from ._plant import AbstractPlant
from ._problem import Problem, check_x0
from ._pulses import Pulses, Pushed
from ._sensor import reading_noise
from ._terms import check
from ._types import promote


class Trajectory(eqx.Module):
    """What happened: times, states, what was sensed, controls and costs.

    Attributes:
        ts: times of the states [s], shape (T+1,).
        xs: true states, shape (T+1, nx).
        us: controls, shape (T, nu).
        ys: what the controller sensed at each step, shape (T, ny).
        costs: the cost of each step and of the last state, shape (T+1,); `cost` is their sum.
    """

    ts: Float[Array, " T+1"]
    xs: Float[Array, "T+1 nx"]
    us: Float[Array, "T nu"]
    ys: Float[Array, "T ny"]
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
    belief: ArrayLike | None = None,
    key: Array | None = None,
    plant: AbstractPlant | None = None,
    noise: AbstractNoise | None = None,
    pulses: Pulses | None = None,
) -> Trajectory:
    """Run a controller from x0 for the problem's duration.

    dx = f(x, u, t) dt + F(x, u, t) dw, by the problem's integrator plus sqrt(dt) F xi (Euler and
    Maruyama, in the sense of Ito); for a discrete plant x' = f(x, u, t) + F xi. The controller is
    told the state, or what the problem's sensor says of it, y = g(x, t) + G eta/sqrt(dt). Trials
    are made by `jax.vmap` over keys.

    Arguments:
        problem: grid, plant, cost and noise. All arrays among the arguments are promoted to one
            floating dtype, the widest among them.
        controller: what acts, such as `solution.policy` or `OpenLoop(us)`.
        x0: true starting state, shape (nx,); with a key and the problem's `x0_cov`, the mean of the
            normal distribution from which it is drawn.
        belief: where the controller believes to start, shape (nx,); x0 by default.
        key: a `jax.random.key`; without one nothing is random: the problem's noise is off, and its
            sensor's.
        plant, noise: what really moves and disturbs, where that differs from the problem's. The
            controller is handed the problem as it is.
        pulses: perturbations from outside.

    Returns: `Trajectory`; its costs are the problem's, for the plant that really moved. NaN where
    a traced time step is not above zero, or a traced `x0_cov` no covariance.

    Raises: ValueError or TypeError, naming the argument, when one does not fit the problem or is
    not finite where that can be known, when `noise` is given without a key, and when the
    controller returns other shapes or dtypes than it should.
    """
    if not isinstance(problem, Problem):
        raise TypeError(f"problem: a jc.Problem is wanted, got {problem!r}")
    problem, controller, plant, noise, pulses = given = converted(
        (problem, controller, plant, noise, pulses)
    )
    problem.check_single()
    check_again(given)
    x0 = check_x0(problem, x0)
    belief = x0 if belief is None else check_x0(problem, belief, "belief")
    _check_controller(controller, problem)
    mover = problem.plant if plant is None else _check_plant(plant, problem.plant)
    noise = _check_noise(problem.noise if noise is None else noise, noise is not None, key)
    if key is not None:
        check_key(key)
        silent = noise is None and problem.x0_cov is None and problem.sensor is None
        if silent and isinstance(controller, AffinePolicy | OpenLoop):
            warnings.warn(
                "key: given, but nothing is random: neither the problem nor this call has `noise`, "
                "nor the problem an `x0_cov` or a `sensor`",
                stacklevel=2,
            )
    pulses = Pulses() if pulses is None else pulses
    if not isinstance(pulses, Pulses):
        raise TypeError(f"pulses: jc.Pulses are wanted, got {pulses!r}")
    pulses.check(mover, problem.num_steps, problem.num_readings)
    check(problem.cost, problem.plant)
    problem, controller, mover, noise = closed((problem, controller, mover, noise))
    problem, controller, mover, noise, pulses, x0, belief = promote(
        (problem, controller, mover, noise, pulses, x0, belief)
    )
    return _run(problem, controller, mover, noise, pulses, x0, belief, key)


def _check_controller(controller: Any, problem: Problem) -> None:
    if not isinstance(controller, AbstractController):
        raise TypeError(
            f"controller: solution.policy or a controller is wanted, got {type(controller)}"
        )
    if (check := getattr(controller, "check", None)) is not None:
        check(problem)


def _check_plant(plant: Any, own: AbstractPlant) -> AbstractPlant:
    if not isinstance(plant, AbstractPlant):
        raise TypeError(f"plant: a plant is wanted, such as InField(arm, Curl()), got {plant!r}")
    if (plant.nx, plant.nu) != (own.nx, own.nu):
        raise ValueError(
            f"plant: {plant.nx} states and {plant.nu} controls, wanted {own.nx} and {own.nu}"
        )
    if plant.discrete != own.discrete:
        kinds = [("a continuous", "a discrete")[p.discrete] for p in (plant, own)]
        raise ValueError(f"plant: {kinds[0]} one for the problem of {kinds[1]} plant")
    return plant


def _check_noise(noise: Any, given: bool, key: Any) -> AbstractNoise | None:
    if noise is None:
        return None
    if not isinstance(noise, AbstractNoise):
        raise TypeError(f"noise: a noise such as jc.AdditiveNoise is wanted, got {noise!r}")
    if given and key is None:
        raise ValueError("key: wanted together with `noise`, got None")
    for path, leaf in jax.tree_util.tree_leaves_with_path(noise):
        known = eqx.is_inexact_array(leaf) and is_concrete(leaf)
        if known and not np.isfinite(np.asarray(leaf)).all():
            raise ValueError(f"noise: {jax.tree_util.keystr(path)[1:]} is not finite: {leaf}")
    return noise


def check_key(key) -> None:
    """Raise TypeError or ValueError for what is no single key."""
    typed = isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    old = hasattr(key, "dtype") and key.dtype == jnp.uint32 and key.ndim >= 1
    if not typed and not old:
        raise TypeError(f"key: a jax.random.key(seed) is wanted, got {key!r}")
    shape = key.shape if typed else key.shape[:-1]
    if shape != ():
        raise ValueError(f"key: got {shape} keys, wanted one; many trials go through jax.vmap")


@jit
def _run(problem: Problem, controller, plant, noise, pulses, x0, belief, key) -> Trajectory:
    T, scale = problem.num_steps, jnp.sqrt(problem.rate)
    start_key, keys, xis, etas = None, None, None, None
    if key is not None:
        start_key, steps_key = jax.random.split(key)
        pairs = jax.vmap(jax.random.split)(jax.random.split(steps_key, T))
        keys = pairs[:, 1]
        if noise is not None:
            xis = _draws(noise, plant, problem, x0, pairs[:, 0])
        if problem.sensor is not None:
            etas = _readings_draws(problem, plant, x0, jax.random.fold_in(start_key, 1))
        if problem.x0_cov is not None:
            xi = jax.random.normal(jax.random.fold_in(start_key, 0), x0.shape, x0.dtype)
            valid = is_covariance(problem.x0_cov)  # where it was traced, no eager check could tell
            x0 = jnp.where(valid, x0 + root(problem.x0_cov) @ xi, jnp.nan)
    _check_step(problem, controller, belief, start_key)

    def body(carry, inputs):
        x, past, memory = carry
        i, t, key, xi, eta, pulse = inputs
        y, past = _sense(problem, plant, x, past, t, eta)
        y = y if pulse.sensed is None else y + pulse.sensed
        memory, u = controller.step(memory, y, i, t, key)
        pushed = plant if pulse.forces is None else Pushed(plant, pulse.forces)
        after = problem.integrator(pushed, x, u, t, problem.dt)
        if pulse.states is not None:
            after = after + pulse.states
        if noise is not None and xi is not None:
            after = after + scale * matmul(diffusion(noise, plant, x, u, t), xi)
        return (after, past, memory), (after, u, y)

    # A time step that was traced until now may be what no eager check could refuse.
    x0 = jnp.where(problem.dt > 0, x0, jnp.nan)
    carry = (x0, _unsensed_yet(problem, plant, x0), controller.init(problem, belief, start_key))
    inputs = (jnp.arange(T), problem.ts[:-1], keys, xis, etas, pulses)
    _, (xs, us, ys) = jax.lax.scan(body, carry, inputs)
    xs = jnp.concatenate([x0[None], xs])
    moved = eqx.tree_at(lambda p: p.plant, problem, plant)
    return Trajectory(problem.ts, xs, us, ys, moved.stage_costs(xs, us))


def _draws(noise: AbstractNoise, plant, problem: Problem, x0, keys) -> Float[Array, "T nw"]:
    """Return xi ~ N(0, I) of every step, each from its own key.

    Not within the scan: there XLA draws one number after the other, here many at a time.
    """
    u, t = jnp.zeros(problem.plant.nu, x0.dtype), problem.ts[0]
    F = jax.eval_shape(lambda: diffusion(noise, plant, x0, u, t))
    return jax.vmap(lambda key: jax.random.normal(key, F.shape[1:], F.dtype))(keys)


def _unsensed_yet(problem: Problem, plant, x0) -> Array | None:
    """Return what a delayed sensor has of the time before the start."""
    if problem.sensor is None:
        return None
    return unchanged(problem.sensor, plant, x0, problem.ts[0])


def _sense(problem: Problem, plant, x, past, t, eta) -> tuple[Array, Array | None]:
    """Return what is told of x (nx,) at time t, noise eta included, and what is remembered then."""
    sensor = problem.sensor
    if sensor is None:
        return x, None
    y, G = told(sensor, plant, past, x, t, problem.dt)
    if eta is not None:
        y = y + matmul(G, eta) / jnp.sqrt(problem.rate)
    return y, shifted(sensor, plant, past, x, t)


def _readings_draws(problem: Problem, plant, x0, key) -> Float[Array, "T nv"]:
    """Return eta ~ N(0, I) of every step."""
    sensor, t = problem.sensor, problem.ts[0]
    assert sensor is not None
    G = jax.eval_shape(lambda: reading_noise(sensor, plant, x0, t))
    return jax.random.normal(key, (problem.num_steps, G.shape[1]), G.dtype)


def _check_step(problem: Problem, controller: AbstractController, belief, key) -> None:
    """Trace a controller once: its own exceptions pass with a note, other shapes are named."""
    name, T = type(controller).__name__, problem.num_steps
    try:
        memory = jax.eval_shape(lambda: controller.init(problem, belief, key))
    except Exception as error:
        error.add_note(f"raised while {name}.init(problem, belief, key) was traced")
        raise
    y = jax.ShapeDtypeStruct((problem.num_readings,), belief.dtype)
    try:
        out = jax.eval_shape(
            lambda memory, y, i: controller.step(memory, y, i, problem.ts[i], key),
            memory,
            y,
            jnp.arange(T)[0],
        )
    except Exception as error:
        error.add_note(
            f"raised while {name}.step(memory, y, i, t, key) was traced, with y {y.shape}; "
            "use jnp.where or jax.lax.cond where it depends on values"
        )
        raise
    if not isinstance(out, tuple) or len(out) != 2:
        raise TypeError(f"{name}.step: a pair (memory, control) is wanted, got {out}")
    after, u = out
    wanted = (problem.plant.nu,)
    if getattr(u, "shape", None) != wanted:
        got = getattr(u, "shape", u)
        raise ValueError(f"{name}.step: returned a control {got}, wanted shape {wanted}")
    if u.dtype != belief.dtype:
        raise TypeError(
            f"{name}.step: returned a control {u.dtype} from a state {belief.dtype}; write "
            "constants as Python numbers, and keep arrays as the controller's fields"
        )
    if _kinds(after) != _kinds(memory):
        raise TypeError(
            f"{name}.step: returned a memory {_shown(after)}, init one {_shown(memory)}; it has to "
            "keep its structure, shapes and dtypes"
        )


def _kinds(tree) -> tuple:
    leaves, structure = jax.tree.flatten(tree)
    return structure, [(leaf.shape, leaf.dtype) for leaf in leaves]


def _shown(tree) -> str:
    return str(jax.tree.map(lambda leaf: f"{leaf.dtype}{list(leaf.shape)}", tree)).replace("'", "")
