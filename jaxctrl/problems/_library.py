"""The benchmarks' problems; each function's docstring states one with all its numbers.

The integral of a rate l stands for sum_k dt l(x_k, u_k), and |x| for the Euclidean norm.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import plants, tasks
from .._cost import FunctionCost, QuadraticCost
from .._function_plant import FunctionPlant
from .._integrate import RK4
from .._problem import Problem
from .._types import array_leaf

LI = "Li (2006), Optimal Control for Biological Movement Systems, section 4.3"
ALTRO = (
    "Altro.jl and RobotZoo.jl, the programs of Howell, Jackson & Manchester (2019), ALTRO: a fast "
    "solver for constrained trajectory optimization"
)


class Posed(NamedTuple):
    """A problem and its start: x0, shape (nx,), and us, shape (T, nu)."""

    problem: Problem
    x0: Float[Array, " nx"]
    us: Float[Array, "T nu"]


def _held(problem: Problem, x0, u) -> Posed:
    """Start with one control (nu,) held all the time."""
    shape = (problem.num_steps, problem.plant.nu)
    return Posed(problem, array_leaf(np.asarray(x0)), jnp.broadcast_to(array_leaf(u), shape))


def _drift(x, u, t):
    return jnp.stack([x[1], u[0]])


def _double_integrator(bounds=None) -> Posed:
    problem = Problem(
        FunctionPlant(_drift, nx=2, nu=1),
        QuadraticCost(Q=1.0, R=0.1, Qf=10.0),
        num_steps=50,
        dt=0.05,
        control_bounds=bounds,
    )
    return _held(problem, [1.0, 0.0], 0.0)


def double_integrator() -> Posed:
    """A mass of 1 kg comes from 1 m to rest at 0.

    dx1/dt = x2, dx2/dt = u; J = 5 |x(T)|^2 + 1/2 int |x|^2 + 0.1 u^2 dt; 50 Euler steps of 50 ms;
    from (1, 0) and u = 0. Linear-quadratic: one iteration.
    """
    return _double_integrator()


def double_integrator_bounded() -> Posed:
    """As double-integrator, with |u| <= 1: still one iteration, a box-constrained quadratic."""
    return _double_integrator((-1.0, 1.0))


def _swing_up(bounds=None) -> Posed:
    plant = plants.Pendulum(control_bounds=bounds)
    return _held(tasks.swing_up(plant, 4.0, num_steps=400), [np.pi, 0.0], 0.0)


def pendulum() -> Posed:
    """A pendulum swings up within 4 s.

    dx1/dt = x2, dx2/dt = g/l sin x1 - mu/(m l^2) x2 + u/(m l^2), with m = 1 kg, l = 1 m,
    g = 9.8 m/s^2, mu = 0.01 N m s/rad; J = 1/2 |x(T)|^2 + 1/2 int 1e-5 u^2 dt; 400 Euler steps of
    10 ms; from (pi, 0), hanging, and u = 0. The thesis's problem with the duration our choice.
    """
    return _swing_up()


def pendulum_bounded() -> Posed:
    """As pendulum, with |u| <= 3 N m, a third of what holds it level: it must swing to and fro."""
    return _swing_up((-3.0, 3.0))


def _effort(x, u, t, p):
    return p["effort"] * u[0] ** 2


def _upright(x, p):
    return (1 - jnp.cos(x[0])) ** 2 + p["rate"] * x[1] ** 2


def pendulum_2005() -> Posed:
    """The bounded pendulum on which iterative LQG was first shown with control limits.

    With y = x1 + pi measured from hanging: dy/dt = x2, dx2/dt = u - 4 sin y, |u| <= 2;
    J = (1 + cos y(T))^2 + 0.1 x2(T)^2 + int 0.01 u^2 dt; 400 Euler steps of 10 ms; from y = 0 at
    rest. Hanging still is stationary, so the start is u = 0.5; it is our choice.
    """
    plant = plants.Pendulum(g=4.0, friction=0.0, control_bounds=(-2.0, 2.0))
    cost = FunctionCost(
        running=_effort,
        terminal=_upright,
        params={"effort": 0.01, "rate": 0.1},
    )
    return _held(Problem(plant, cost, num_steps=400, dt=0.01), [-np.pi, 0.0], 0.5)


def cart_pole() -> Posed:
    """A cart-pole swings up within 5 s and comes back to where it was.

    The plant is jc.plants.CartPole: M = 1 kg, m = 0.2 kg, l = 0.5 m, g = 9.81 m/s^2;
    x = (position, angle from hanging, rates), x* = (0, pi, 0, 0), |u| <= 3 N;
    J = 50 |x(T) - x*|^2 + 1/2 int 0.01 |x - x*|^2 + 0.1 u^2 dt; 100 Runge-Kutta steps of 50 ms;
    from rest at 0 and u = 0.01. ALTRO's problem asks besides for x(T) = x* exactly, and takes
    Runge-Kutta steps of third order.
    """
    cost = QuadraticCost(Q=1e-2, R=1e-1, Qf=100.0, target=np.array([0.0, np.pi, 0.0, 0.0]))
    plant = plants.CartPole(control_bounds=(-3.0, 3.0))
    return _held(Problem(plant, cost, num_steps=100, dt=0.05, integrator=RK4()), np.zeros(4), 0.01)


def acrobot() -> Posed:
    """An acrobot stands up within 5 s.

    The plant is jc.plants.Acrobot: masses of 1 kg at the ends of links of 1 m, moments of inertia
    1 kg m^2, friction 1 N m s/rad, g = 9.81 m/s^2; x = (q, dq), x* = (pi/2, 0, 0, 0),
    |u| <= 15 N m; J = 50 |x(T) - x*|^2 + 1/2 int |x - x*|^2 + 0.01 u^2 dt; 100 Runge-Kutta steps of
    50 ms; from (-pi/2, 0, 0, 0), hanging, and u = 0. ALTRO's problem asks besides for x(T) = x*
    exactly.
    """
    cost = QuadraticCost(Q=1.0, R=1e-2, Qf=100.0, target=np.array([np.pi / 2, 0.0, 0.0, 0.0]))
    plant = plants.Acrobot(control_bounds=(-15.0, 15.0))
    problem = Problem(plant, cost, num_steps=100, dt=0.05, integrator=RK4())
    return _held(problem, [-np.pi / 2, 0.0, 0.0, 0.0], 0.0)


def _smooth(x, width):
    """The absolute value, rounded within `width`."""
    return jnp.sqrt(x**2 + width**2) - width


def _parking_step(x, u, t, p):
    near = jnp.sum(p["near"] * _smooth(x[:2], p["near_width"]))
    return jnp.sum(p["control"] * u**2) + near


def _parked(x, p):
    return jnp.sum(p["parked"] * _smooth(x, p["parked_width"]))


def car_parking() -> Posed:
    """A car parks at the origin, heading along x, with a change of direction on the way.

    The plant is jc.plants.Car: axles 2 m apart, 500 steps of 30 ms; x = (x, y, heading, speed),
    u = (wheel angle w, acceleration a), |w| <= 0.5 rad, |a| <= 2 m/s^2. With
    z(p, e) = sqrt(p^2 + e^2) - e, J is the sum over steps of
    0.01 w^2 + 0.0001 a^2 + 0.001 (z(x, 0.1) + z(y, 0.1)), and at the end of
    0.1 z(x, 0.01) + 0.1 z(y, 0.01) + z(heading, 0.01) + 0.3 z(speed, 1). From (1, 1, 3 pi/2, 0) and
    normal random controls of standard deviation 0.1, as published; ours are NumPy's
    `0.1 * default_rng(5).standard_normal((500, 2))`.
    """
    plant = plants.Car(control_bounds=(np.array([-0.5, -2.0]), np.array([0.5, 2.0])))
    params = {
        "control": jnp.array([1e-2, 1e-4]),
        "near": 1e-3,
        "near_width": 0.1,
        "parked": jnp.array([0.1, 0.1, 1.0, 0.3]),
        "parked_width": jnp.array([0.01, 0.01, 0.01, 1.0]),
    }
    cost = FunctionCost(running=_parking_step, terminal=_parked, params=params)
    us = 0.1 * np.random.default_rng(5).standard_normal((500, 2))
    problem = Problem(plant, cost, num_steps=500, dt=0.03)
    return Posed(problem, plant.at_rest(jnp.ones(2), 1.5 * np.pi), array_leaf(us))


def _hovering(x, u, t, p):
    off = jnp.sum((x - p["target"]) ** 2)
    return 0.5 * (p["state"] * off + p["control"] * jnp.sum((u - p["hover"]) ** 2))


def _hovered(x, p):
    return 0.5 * jnp.sum((x - p["target"]) ** 2)


def planar_quadrotor() -> Posed:
    """A quadrotor in a plane flies 10 m aside and 1 m down, and hovers.

    The plant is jc.plants.PlanarQuadrotor: m = 1 kg, rotors 0.3 m apart, J = 0.2 m l^2,
    g = 9.81 m/s^2; x = (x, y, tilt, rates), x* = (0, 1, 0, 0, 0, 0), thrusts between 0.2 and
    0.6 m g; J = 1/2 |x_T - x*|^2 + 1/2 sum_k |x_k - x*|^2 + 0.01 |u_k - m g/2|^2; 200 Runge-Kutta
    steps of 50 ms; from (10, 2, 0, 0, 0, 0), hovering.
    """
    weight, dt = 9.81, 0.05
    plant = plants.PlanarQuadrotor(control_bounds=(0.2 * weight, 0.6 * weight))
    params = {
        "target": jnp.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0]),
        "hover": 0.5 * weight,
        "state": 1.0 / dt,
        "control": 0.01 / dt,
    }
    cost = FunctionCost(
        running=_hovering,
        terminal=_hovered,
        params=params,
    )
    problem = Problem(plant, cost, num_steps=200, dt=dt, integrator=RK4())
    return _held(problem, plant.at_rest(jnp.array([10.0, 2.0])), 0.5 * weight)


def torque_arm() -> Posed:
    """The two-link arm turns its shoulder by torques, and stops.

    The plant is jc.plants.TorqueArm; J = 1/2 |q(T) - q*|^2 + 1/2 |dq(T)|^2 + 1/2 int 1e-4 |u|^2 dt,
    q* = (1, 1.5) rad; 50 Euler steps of 10 ms; from (1.5, 1.5) rad at rest and u = 0. The start is
    our choice, and the second term, which the thesis's text demands and its formula lacks.
    """
    arm = plants.TorqueArm()
    problem = tasks.posture(arm, jnp.array([1.0, 1.5]), 0.5, num_steps=50)
    return _held(problem, arm.at_rest(shoulder=1.5, elbow=1.5), 0.0)


def _muscle_arm(arm: plants.MuscleArm) -> Posed:
    problem = tasks.posture(arm, jnp.array([1.0, 1.5]), 0.5, num_steps=50)
    return _held(problem, arm.at_rest(shoulder=1.5, elbow=1.5), arm.nominal_control)


def muscle_arm() -> Posed:
    """The movement of torque-arm by six muscles.

    The plant is jc.plants.MuscleArm, 0 <= u <= 1; cost and grid as torque-arm's; from rest without
    activation and u = 0.05 for each muscle. It has several optima, within 2e-5 of one another.
    """
    return _muscle_arm(plants.MuscleArm())


def muscle_arm_brown() -> Posed:
    """As muscle-arm, with the active state of Brown, Cheng & Loeb (1999).

    The plant is jc.plants.MuscleArm(active_state="brown"). It has several optima, within 6e-4 of
    one another, and from this start both solvers end in one that is not the best.
    """
    return _muscle_arm(plants.MuscleArm(active_state="brown"))


def _chain(n: int) -> Callable[[], Posed]:
    def build() -> Posed:
        plant = plants.Chain(n)
        bent = 0.3 * jnp.ones(n)
        posture = tasks.posture(plant, bent + 0.4 / n, 0.5, num_steps=50, effort=1e-2)
        rates = QuadraticCost(Q=0.01 * jnp.repeat(jnp.array([0.0, 1.0]), n))
        problem = Problem(plant, posture.cost + rates, num_steps=50, dt=0.01)
        return _held(problem, plant.at_rest(bent), 0.0)

    build.__doc__ = f"""A chain of {n} rods unrolls by {0.4 / n:g} rad in each joint, and stops.

    The plant is jc.plants.Chain({n}), 0.63 m and 2.4 kg in all, friction 0.05 (2/n)^3 N m s/rad;
    J = 1/2 |q(T) - q*|^2 + 1/2 |dq(T)|^2 + 1/2 int 0.01 |u|^2 + 0.01 |dq|^2 dt; 50 Euler steps of
    10 ms; from 0.3 rad in each joint at rest and u = 0. Without the price on rates it is cheapest
    to crack the light outer links like a whip.
    """
    return build


OURS = "ours, on the family of fig. 5.6 in Li (2006)"
LIBRARY: dict[str, tuple[str, Callable[[], Posed]]] = {
    "double-integrator": ("textbook", double_integrator),
    "double-integrator-bounded": ("textbook", double_integrator_bounded),
    "pendulum": (f"{LI}, eq. 4.21-4.23", pendulum),
    "pendulum-bounded": (f"{LI}, eq. 4.21-4.23; the bound is ours", pendulum_bounded),
    "pendulum-2005": (
        "Todorov & Li (2005), A generalized iterative LQG method for locally-optimal feedback "
        "control of constrained nonlinear stochastic systems, section on the inverted pendulum",
        pendulum_2005,
    ),
    "cart-pole": (ALTRO, cart_pole),
    "acrobot": (ALTRO, acrobot),
    "car-parking": (
        "Tassa, Mansard & Todorov (2014), Control-limited differential dynamic programming, and "
        "its program demo_car.m",
        car_parking,
    ),
    "planar-quadrotor": (
        "Manchester's course Optimal Control and Reinforcement Learning (CMU 16-745), notebook on "
        "predictive control, there with linearised dynamics; the plant is RobotZoo.jl's",
        planar_quadrotor,
    ),
    "torque-arm": (f"{LI}, eq. 4.20", torque_arm),
    "muscle-arm": (f"{LI}, eq. 4.20", muscle_arm),
    "muscle-arm-brown": (f"{LI}, eq. 4.20", muscle_arm_brown),
    "chain-2": (OURS, _chain(2)),
    "chain-4": (OURS, _chain(4)),
    "chain-8": (OURS, _chain(8)),
}
"""The source of each problem, and the function that makes it."""
