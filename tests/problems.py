"""Every kind of problem that the package builds, each with its start: shared by several tests."""

import jax
import jax.numpy as jnp

import jaxctrl as jc


def _pendulum(**arguments):
    plant = jc.plants.Pendulum(**arguments)
    return jc.tasks.swing_up(plant, 2.0, num_steps=100), jnp.array([jnp.pi, 0.0])


def _torque(task, **arguments):
    arm = jc.plants.TorqueArm(**arguments)
    return task(arm), arm.at_rest(shoulder=0.785, elbow=1.571)


def _muscle(task, **arguments):
    arm = jc.plants.MuscleArm(**arguments)
    return task(arm), arm.at_rest(shoulder=0.785, elbow=1.571)


def _chain(n, **arguments):
    """Unroll a bent chain by 0.4/n rad in each joint, with a price on the joints' velocities.

    Without that price it is cheapest to crack the light outer links like a whip.
    """
    chain = jc.plants.Chain(n)
    bent = 0.3 * jnp.ones(n)
    posture = jc.tasks.posture(chain, bent + 0.4 / n, 0.5, effort=1e-2)
    price = jc.QuadraticCost(Q=jnp.concatenate([jnp.zeros(n), 0.01 * jnp.ones(n)]))
    problem = jc.Problem(chain, posture.cost + price, num_steps=50, dt=0.01)
    if arguments:
        problem = with_bounds(problem, arguments["bounds"])
    return problem, chain.at_rest(bent)


def with_bounds(problem, bounds):
    """Return the same problem with other control bounds."""
    return jc.Problem(
        problem.plant,
        problem.cost,
        num_steps=problem.num_steps,
        dt=problem.dt,
        control_bounds=bounds,
        integrator=problem.integrator,
    )


def _with(pair, bounds):
    return with_bounds(pair[0], bounds), pair[1]


def reach(arm):
    """A 11 cm reach up and to the left."""
    return jc.tasks.reach(arm, jnp.array([-0.1, 0.53]), 0.5)


def obstacle(arm):
    """A longer reach with a disc in its way; the nominal controls do not run into it."""
    return jc.tasks.obstacle(arm, jnp.array([-0.15, 0.5]), jnp.array([-0.095, 0.475]), 0.02, 0.7)


def hit(arm):
    """The same reach, arriving with a speed."""
    return jc.tasks.hit(arm, jnp.array([-0.1, 0.53]), jnp.array([0.0, 0.5]), 0.5)


def via(arm):
    """The same reach, through two points off the grid of time."""
    points = jnp.array([[0.02, 0.48], [-0.05, 0.54]])
    return jc.tasks.via(arm, jnp.array([-0.1, 0.53]), points, jnp.array([0.153, 0.327]), 0.5)


def posture(arm):
    """A movement of both joints."""
    return jc.tasks.posture(arm, jnp.array([1.0, 1.3]), 0.5)


def _double_integrator():
    plant = jc.FunctionPlant(lambda x, u, t: jnp.array([x[1], u[0]]), nx=2, nu=1)
    cost = jc.QuadraticCost(Q=1.0, R=0.1, Qf=10.0)
    return jc.Problem(plant, cost, num_steps=50, dt=0.05), jnp.array([1.0, 0.0])


def _discrete():
    def dynamics(x, u, t, p):
        return jnp.array([x[0] + 0.1 * x[1], x[1] + 0.1 * (u[0] - p * x[0] ** 3)])

    plant = jc.FunctionPlant(dynamics, nx=2, nu=1, params=1.5, discrete=True)
    cost = jc.FunctionCost(
        running=lambda x, u, t: 0.01 * (x @ x + u @ u), terminal=lambda x: jnp.sum((x - 1) ** 2)
    )
    return jc.Problem(plant, cost, num_steps=40), jnp.array([1.0, -1.0])


def _runge_kutta():
    problem, x0 = _torque(reach)
    return jc.Problem(problem.plant, problem.cost, num_steps=25, dt=0.02, integrator=jc.RK4()), x0


def _barrier():
    """A swing-up whose speed a logarithm limits: curvatures of very different sizes."""

    def running(x, u, t):
        return 1e-3 * u[0] ** 2 - 1e-1 * jnp.log(1.2 + x[1] / 3.0)

    plant = jc.plants.Pendulum()
    cost = jc.FunctionCost(running=running, terminal=lambda x: 20 * jnp.sum(x**2))
    return jc.Problem(plant, cost, num_steps=30, dt=0.05), jnp.array([2.5, 0.0])


PROBLEMS = {
    "double integrator": _double_integrator,
    "discrete": _discrete,
    "pendulum": _pendulum,
    "pendulum, barrier": _barrier,
    "pendulum, bounded": lambda: _with(_pendulum(), (-3.0, 3.0)),
    "torque arm, reach": lambda: _torque(reach),
    "torque arm, reach, RK4": _runge_kutta,
    "torque arm, reach, bounded": lambda: _with(_torque(reach), (-0.5, 0.5)),
    "torque arm, posture": lambda: _torque(posture),
    "torque arm, obstacle": lambda: _torque(obstacle),
    "torque arm, hit": lambda: _torque(hit),
    "torque arm, via": lambda: _torque(via),
    "muscle arm, reach": lambda: _muscle(reach),
    "muscle arm, constant arms": lambda: _muscle(reach, arms="constant"),
    "muscle arm, posture": lambda: _muscle(posture),
    "muscle arm, obstacle": lambda: _muscle(obstacle),
    "muscle arm, via": lambda: _muscle(via),
    "muscle arm, bounded hard": lambda: _with(_muscle(reach), (0.0, 0.25)),
    "chain of 4": lambda: _chain(4),
    "chain of 8": lambda: _chain(8),
    "chain of 8, bounded": lambda: _chain(8, bounds=(-0.3, 0.3)),
}


def gradient(problem, x0, us):
    """Return the gradient (T, nu) of the cost by reverse-mode differentiation of the roll-out."""
    return jax.grad(lambda us: problem.total_cost(problem.rollout(x0, us), us))(us)
