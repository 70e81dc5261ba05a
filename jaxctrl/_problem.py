"""A control problem: a plant, a cost, noise, a sensor and bounds on a grid of time."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from ._checks import check_array, check_instance, check_integer, is_concrete, shape_of
from ._delay import delayed, unchanged, with_buffers
from ._function import closed
from ._integrate import AbstractIntegrator, Euler, NextState
from ._noise import AbstractNoise
from ._plant import AbstractPlant, check_plant, nominal_control
from ._sensor import AbstractSensor, num_readings
from ._terms import AbstractCost, At, Events, Terms, check, parts, terms
from ._types import Bounds, array_leaf, as_bounds, clip


class Problem(eqx.Module):
    """Minimise a cost over the controls of a plant during a fixed time.

    The grid has T = `num_steps` controls and T + 1 states, `duration` = T dt. With a continuous
    plant each control is held over its step. Every number is an array leaf: a problem may be
    batched by vmap, differentiated with `jax.grad`, and changed without recompiling.

    Arguments:
        plant: what moves.
        cost: what to minimise; handed the plant at each call.
        num_steps: T, at least 1; static.
        dt: time step [s].
        noise: process noise, or None; several by `+`. `ILQG` plans with it, `ILQR` without;
            `simulate` lets it act.
        sensor: what a controller is told of the state, such as `JointSensor()`, several by `+`;
            None, where it knows the state. `ILQG` plans with it, a filter beside the law; `ILQR`
            without.
        x0_cov: covariance of the first state around the x0 that is given, shape (nx, nx), positive
            semidefinite; None, where it is known exactly. `simulate` draws the start from it.
        control_bounds: (lower, upper), scalars or shapes (nu,) or (T, nu); None takes the plant's
            own, (-inf, inf) removes them. `problem.bounds` are those in use, each (T, nu);
            `problem.control_bounds` is None where they are the plant's.
        integrator: `Euler()` by default for continuous plants; a discrete plant is its own.

    For other bounds make a new `Problem`, or, where the plant was made with some, replace them:
    `eqx.tree_at(lambda p: p.plant.control_bounds, problem, (lower, upper))`, each (nu,).

    Raises ValueError or TypeError, naming the argument, when one does not fit.
    """

    plant: AbstractPlant
    cost: AbstractCost
    num_steps: int = eqx.field(static=True)
    dt: Float[Array, ""]
    noise: AbstractNoise | None
    sensor: AbstractSensor | None
    control_bounds: Bounds | None
    integrator: AbstractIntegrator
    x0_cov: Float[Array, "nx nx"] | None

    def __init__(
        self,
        plant: AbstractPlant,
        cost: AbstractCost,
        *,
        num_steps: int,
        dt: ArrayLike = 0.01,
        noise: AbstractNoise | None = None,
        sensor: AbstractSensor | None = None,
        x0_cov: ArrayLike | None = None,
        control_bounds: tuple[ArrayLike, ArrayLike] | None = None,
        integrator: AbstractIntegrator | None = None,
    ):
        check_instance("plant", plant, AbstractPlant, "a plant or a jc.FunctionPlant is wanted")
        check_instance("cost", cost, AbstractCost, "a cost or a jc.FunctionCost is wanted")
        check_instance(
            "noise", noise, AbstractNoise | None, "jc.SignalDependentNoise or its like is wanted"
        )
        check_instance(
            "sensor", sensor, AbstractSensor | None, "jc.JointSensor() or its like is wanted"
        )
        check_instance(
            "integrator", integrator, AbstractIntegrator | None, "jc.RK4() or its like is wanted"
        )
        check_plant(plant)
        self.plant = closed(plant)
        self.cost = closed(cost)
        self.num_steps = num_steps = check_integer("num_steps", num_steps, 1)
        self.dt = array_leaf(dt, "dt")
        self.noise = closed(noise)
        self.sensor = closed(with_buffers(sensor, self.dt, num_steps))
        self.control_bounds = as_bounds(
            control_bounds, _bounds_shape(control_bounds, plant.nu, num_steps)
        )
        if integrator is None:
            integrator = NextState() if plant.discrete else Euler()
        elif plant.discrete != isinstance(integrator, NextState):
            raise ValueError(
                f"integrator: {type(integrator).__name__} does not fit a plant with "
                f"discrete={plant.discrete}"
            )
        self.integrator = integrator
        self.x0_cov = None if x0_cov is None else array_leaf(x0_cov, "x0_cov")

    def __check_init__(self):
        for name in ("nx", "nu"):  # a plant of the user's own class may have any
            check_integer(f"plant: {name}", getattr(self.plant, name), 1)
        if self.dt.shape != ():
            raise ValueError(f"dt: one number is wanted, got shape {self.dt.shape}")
        if is_concrete(self.dt) and not np.asarray(self.dt) > 0:  # jnp would trace it, under jit
            raise ValueError(f"dt: a positive time step is wanted, got {self.dt}")
        with_buffers(self.sensor, self.dt, self.num_steps)
        _check_covariance("x0_cov", self.x0_cov, self.plant.nx)
        bounds = self.bounds
        if bounds is not None and is_concrete(*bounds):
            lower, upper = np.asarray(bounds[0]), np.asarray(bounds[1])
            if not (lower <= upper).all():
                step, i = np.argwhere(~(lower <= upper))[0]
                raise ValueError(
                    f"control_bounds: lower <= upper is wanted, got {lower[step, i]} > "
                    f"{upper[step, i]} for control {i}"
                )
        _check_obstacles(self.cost)
        for group in terms(self.cost).events:
            times = group.times
            if is_concrete(times, self.dt):
                times, duration = np.asarray(times), self.num_steps * np.asarray(self.dt)
                outside = (times < 0) | (times > duration * (1 + 1e-6))
                if outside.any():
                    raise ValueError(
                        f"cost: an event at {times[outside][0]} s lies outside the "
                        f"movement, which lasts from 0 to {float(duration):.6g} s"
                    )

    def check_single(self) -> None:
        """Raise ValueError when this is a batch of problems, where one, with dt (), is wanted."""
        if self.dt.shape != ():
            raise ValueError(
                f"problem: a batch, its dt has shape {self.dt.shape}; it goes through jax.vmap"
            )

    def __add__(self, further: AbstractCost | AbstractNoise | AbstractSensor) -> "Problem":
        """Return the problem with a further cost, `task + Obstacle(...)`, noise or sensor."""
        if isinstance(further, AbstractNoise):
            both = closed(further if self.noise is None else self.noise + further)
            return eqx.tree_at(lambda p: p.noise, self, both, is_leaf=lambda leaf: leaf is None)
        if isinstance(further, AbstractSensor):
            self.check_single()
            both = further if self.sensor is None else self.sensor + further
            both = closed(with_buffers(both, self.dt, self.num_steps))
            return eqx.tree_at(lambda p: p.sensor, self, both, is_leaf=lambda leaf: leaf is None)
        if not isinstance(further, AbstractCost):
            return NotImplemented
        problem = eqx.tree_at(lambda p: p.cost, self, self.cost + further)
        problem.__check_init__()
        return problem

    @property
    def duration(self) -> Float[Array, ""]:
        """The time from the first state to the last, T dt [s], shape ()."""
        return self.num_steps * self.dt

    @property
    def ts(self) -> Float[Array, " T+1"]:
        """The times of the states [s], shape (T+1,)."""
        self.check_single()
        return jnp.arange(self.num_steps + 1, dtype=self.dt.dtype) * self.dt

    @property
    def bounds(self) -> Bounds | None:
        """The bounds that hold, the problem's or else the plant's, each (T, nu); None without."""
        self.check_single()
        bounds = self.plant.control_bounds if self.control_bounds is None else self.control_bounds
        bounds = as_bounds(bounds, (self.num_steps, self.plant.nu))
        # A plant may state them as Python's numbers, whose dtype is nobody's.
        return bounds and (bounds[0].astype(self.dt.dtype), bounds[1].astype(self.dt.dtype))

    @property
    def nominal_controls(self) -> Float[Array, "T nu"]:
        """The plant's nominal control at each step, within the bounds, shape (T, nu)."""
        shape = (self.num_steps, self.plant.nu)
        return clip(jnp.broadcast_to(nominal_control(self.plant), shape), self.bounds)

    @property
    def rate(self) -> Array | float:
        """The weight of the running cost in one step: dt [s], or 1 for a discrete plant."""
        return 1.0 if self.plant.discrete else self.dt

    def step(
        self, x: Float[Array, " nx"], u: Float[Array, " nu"], t: ArrayLike
    ) -> Float[Array, " nx"]:
        """Return the state (nx,) one step after x (nx,) at time t [s] under u (nu,)."""
        return self.integrator(self.plant, x, u, t, self.dt)

    @property
    def uncertain(self) -> bool:
        """Whether anything is random: the start, the movement, or what is sensed."""
        return not (self.noise is None and self.sensor is None and self.x0_cov is None)

    @property
    def num_readings(self) -> int:
        """The number of readings that a controller is told, ny: nx without a sensor."""
        if self.sensor is None:
            return self.plant.nx
        x = jax.ShapeDtypeStruct((self.plant.nx,), self.dt.dtype)
        return num_readings(self.sensor, self.plant, x, self.dt)

    def lift(self, x: Float[Array, " nx"]) -> Float[Array, " nz"]:
        """Return the state (nz,) that a solver plans in, for a state x (nx,) that has lasted.

        With delayed sensors, what has been sensed of it follows; otherwise it is x itself.
        """
        if self.sensor is None or not delayed(self.sensor):
            return x
        return jnp.concatenate([x, unchanged(self.sensor, self.plant, x, self.ts[0])])

    def project(self, xs: Float[Array, "*batch nz"]) -> Float[Array, "*batch nx"]:
        """Return the plant's own states (*batch, nx) of states that a solver plans in."""
        return xs[..., : self.plant.nx]

    def rollout(self, x0: Float[Array, " nx"], us: Float[Array, "T nu"]) -> Float[Array, "T+1 nx"]:
        """Return the states (T+1, nx) from x0 (nx,) under the controls us (T, nu), unclipped."""

        def body(x, inputs):
            u, t = inputs
            x = self.step(x, u, t)
            return x, x

        _, xs = jax.lax.scan(body, x0, (us, self.ts[:-1]))
        return jnp.concatenate([x0[None], xs])

    def replay(self, xs: Float[Array, "T+1 nx"], us: Float[Array, "T nu"]) -> Float[Array, "T nx"]:
        """Return each next state (T, nx) of the trajectory's own states and controls us (T, nu)."""
        return jax.vmap(self.step)(xs[:-1], us, self.ts[:-1])

    def stage_costs(
        self, xs: Float[Array, "T+1 nx"], us: Float[Array, "T nu"]
    ) -> Float[Array, " T+1"]:
        """Return the cost of each step and of the last state, shape (T+1,).

        An event's cost counts in the step within which it lies.
        """
        steps, terms = jnp.arange(self.num_steps), self.terms
        costs = self.rate * jax.vmap(self.running)(xs[:-1], us, self.ts[:-1], steps)
        if terms.residuals:
            rho = jax.vmap(self.residual)(xs[:-1], us, xs[1:], steps)
            costs = costs + 0.5 * jnp.sum(rho**2, axis=1)
        for group in terms.events:
            k, value, _ = self.event_values(group, xs)
            costs = costs.at[k].add(value)
        return jnp.append(costs, self.end(xs[-1]))

    def total_cost(self, xs: Float[Array, "T+1 nx"], us: Float[Array, "T nu"]) -> Float[Array, ""]:
        """Return the cost of a trajectory xs (T+1, nx), us (T, nu), shape ()."""
        return jnp.sum(self.stage_costs(xs, us))

    @property
    def terms(self) -> Terms:
        """What the cost is the sum of; raises ValueError for numbers that do not fit the plant."""
        check(self.cost, self.plant)
        return terms(self.cost)

    def running(
        self,
        x: Float[Array, " nx"],
        u: Float[Array, " nu"],
        t: ArrayLike,
        i: Int[ArrayLike, ""] | None = None,
    ) -> Float[Array, ""]:
        """Return the cost's rate at a state x (nx,) and control u (nu,), shape ().

        At the time t [s], in step i; without i, in the step within which t lies.
        """
        s = t / self.duration if i is None else jnp.asarray(i, self.dt.dtype) / self.num_steps
        i = self.event_steps(jnp.asarray(t))[0] if i is None else jnp.asarray(i)
        at = At(x, u, None, jnp.asarray(t), i, self.dt, jnp.asarray(s))
        rates = (term.value(self.plant, at) for term in self.terms.rates)
        return sum(rates, jnp.zeros((), x.dtype))

    def end(self, x: Float[Array, " nx"]) -> Float[Array, ""]:
        """Return the cost of the last state x (nx,), shape ()."""
        ends = (term.value(self.plant, x) for term in self.terms.ends)
        return sum(ends, jnp.zeros((), x.dtype))

    def residual(
        self,
        x: Float[Array, " nx"],
        u: Float[Array, " nu"],
        after: Float[Array, " nx"],
        i: Int[ArrayLike, ""],
    ) -> Float[Array, " m"]:
        """Return the residuals (m,) of the costs of step i, whose cost is half their square.

        The step leads from x (nx,) under u (nu,) to `after` (nx,).
        """
        root, i = jnp.sqrt(jnp.asarray(self.rate, x.dtype)), jnp.asarray(i)
        k = i.astype(self.dt.dtype)
        at = At(x, u, after, k * self.dt, i, self.dt, k / self.num_steps)
        parts = (term.value(self.plant, at) for term in self.terms.residuals)
        return root * jnp.concatenate([jnp.zeros((0,), x.dtype), *parts])

    def event_steps(self, times: Float[Array, " m"]) -> tuple[Array, Array]:
        """Return the step k (m,) in which each time lies, and the fraction of that step (m,).

        The fraction is NaN for times outside the movement.
        """
        position = times / self.dt
        k = jnp.clip(jnp.floor(jax.lax.stop_gradient(position)), 0, self.num_steps - 1)
        inside = (position >= 0) & (position <= self.num_steps * (1 + 1e-6))
        return k.astype(int), jnp.where(inside, position - k, jnp.nan)

    def event_values(self, group: Events, xs: Float[Array, "T+1 nx"]) -> tuple[Array, Array, Array]:
        """Return for each of m events its step k, its cost and the interpolated state (m, nx)."""
        k, fraction = self.event_steps(group.times)
        states = xs[k] + fraction[:, None] * (xs[k + 1] - xs[k])
        value = jax.vmap(group.value, in_axes=(None, 0, 0))
        return k, value(self.plant, states, jnp.arange(k.size)), states


def _check_obstacles(cost: AbstractCost) -> None:
    """Raise ValueError where a target of the cost is known to lie inside one of its obstacles."""
    marks = [getattr(part, "marks", None) for part in parts(cost)]
    for obstacles in (m.obstacles for m in marks if m is not None):
        for targets in (m.targets for m in marks if m is not None):
            if not is_concrete(obstacles, targets) or not len(obstacles) or not len(targets):
                continue
            discs, points = np.asarray(obstacles), np.asarray(targets)
            if discs.ndim != 2 or points.ndim != 2 or discs.shape[1] != points.shape[1] + 1:
                continue  # a batch, or shapes that are refused elsewhere, by name
            gap = np.linalg.norm(points[:, None] - discs[:, :-1], axis=-1) - discs[:, -1]
            if (gap <= 0).any():
                i, j = np.argwhere(gap <= 0)[0]
                raise ValueError(
                    f"target: lies inside the obstacle, {gap[i, j] + discs[j, -1]:.4g} m from its "
                    f"centre; its radius is {discs[j, -1]:.4g} m"
                )


def _check_covariance(name: str, covariance: Array | None, n: int) -> None:
    """Raise ValueError for what is no covariance (n, n), where values can be known."""
    if covariance is None:
        return
    if covariance.shape != (n, n):
        raise ValueError(f"{name}: got shape {covariance.shape}, wanted ({n}, {n})")
    if not is_concrete(covariance):
        return
    values = np.asarray(covariance)
    if not np.isfinite(values).all():
        raise ValueError(f"{name}: not finite")
    room = np.finfo(values.dtype).eps ** 0.5 * np.abs(values).max(initial=0.0)
    if np.abs(values - values.T).max() > room:
        raise ValueError(f"{name}: a symmetric matrix is wanted, got {values}")
    lowest = np.linalg.eigvalsh(values).min()
    if lowest < -room:
        raise ValueError(
            f"{name}: a positive semidefinite matrix is wanted, got one with eigenvalue {lowest:g}"
        )


def _bounds_shape(bounds, nu: int, num_steps: int) -> tuple[int, ...]:
    pair = isinstance(bounds, tuple | list)  # what is none is refused by `as_bounds`
    per_step = pair and any(len(shape_of(bound)) == 2 for bound in bounds)
    return (num_steps, nu) if per_step else (nu,)


def check_x0(problem: Problem, x0: ArrayLike, name: str = "x0") -> Float[Array, " nx"]:
    """Return x0 as an array (nx,); raises ValueError or TypeError naming it."""
    nx = problem.plant.nx
    shape = shape_of(x0)
    hint = ""
    if shape == (nx, 1):
        hint = "drop the second axis"
    elif len(shape) == 2 and shape[1] == nx:
        hint = "a batch goes through jax.vmap"
    elif hasattr(problem.plant, "lift"):
        hint = "plant.lift(x0) or model.start(task, x0) gives it from a state of the arm"
    return check_array(name, x0, (nx,), hint)


def check_us(problem: Problem, us: ArrayLike | None) -> Float[Array, "T nu"]:
    """Return the starting controls (T, nu), the nominal ones for None; raises like `check_x0`."""
    if us is None:
        return problem.nominal_controls
    wanted = (problem.num_steps, problem.plant.nu)
    shape = shape_of(us)
    hint = ""
    if shape == wanted[::-1]:
        hint = "time is the leading axis: transpose it"
    elif shape == (wanted[0] + 1, wanted[1]):
        hint = "there is one control fewer than states: drop the last row"
    elif shape == wanted[:1] and wanted[1] == 1:
        hint = "add the control axis, us[:, None]"
    elif len(shape) == 3 and shape[1:] == wanted:
        hint = "a batch goes through jax.vmap"
    return check_array("us", us, wanted, hint)
