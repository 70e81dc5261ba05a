"""The benchmarks of `jaxctrl.problems` for CasADi, with numbers and starts of their own."""

from functools import partial

import casadi as ca
import casadi_models as models
import casadi_robots as robots
import numpy as np
from nlp import OPTIONS, Discretised, Outcome, pack, rollout, transcribe
from oracle_cases import FREE, Cost, posture_cost

PATIENCE = {**OPTIONS, "warm_start_init_point": "no", "max_iter": 3000, "mu_strategy": "adaptive"}


def _problem(model, running, terminal, x0, dt, bounds=FREE) -> Discretised:
    """Put functions of symbols (x, u) and (x) together; dt multiplies the running cost."""
    x0 = np.asarray(x0, float)
    nu = model.step.size1_in(1)
    x, u = ca.SX.sym("x", x0.size), ca.SX.sym("u", nu)
    lower, upper = (np.broadcast_to(np.asarray(bound, float), (nu,)) for bound in bounds)
    return Discretised(
        model,
        ca.Function("running", [x, u], [running(x, u)]),
        ca.Function("terminal", [x], [terminal(x)]),
        x0,
        dt,
        lower,
        upper,
    )


def _costed(model, cost: Cost, x0, dt, bounds=FREE) -> Discretised:
    """The same with a cost of `oracle_cases`."""
    running, terminal = cost.functions(len(x0), model.step.size1_in(1))
    return _problem(model, running, terminal, x0, dt, bounds)


def double_integrator(bounds=FREE) -> Discretised:
    """A mass of 1 kg, by its kinetic energy."""
    q, dq, u = ca.SX.sym("q"), ca.SX.sym("dq"), ca.SX.sym("u")
    M, C = models.lagrange(q, dq, 0.5 * dq**2)
    return _problem(
        models.euler(q, dq, u, M, u - C, q),
        lambda x, u: 0.5 * (ca.sumsqr(x) + 0.1 * ca.sumsqr(u)),
        lambda x: 5 * ca.sumsqr(x),
        [1, 0],
        0.05,
        bounds,
    )


def pendulum(bounds=FREE) -> Discretised:
    """The thesis's pendulum."""
    cost = Cost(lambda x: 0.5 * ca.sumsqr(x), effort=1e-5)
    return _costed(models.pendulum(), cost, [np.pi, 0.0], 0.01, bounds)


def pendulum_2005() -> Discretised:
    """The pendulum of Todorov and Li, its angle y from hanging written out."""
    return _problem(
        models.pendulum(g=4.0, friction=0.0),
        lambda x, u: 0.01 * ca.sumsqr(u),
        lambda x: (1 + ca.cos(x[0] + np.pi)) ** 2 + 0.1 * x[1] ** 2,
        [-np.pi, 0.0],
        0.01,
        (-2.0, 2.0),
    )


def _tracking(model, target, x0, Q, R, Qf, bounds) -> Discretised:
    return _problem(
        model,
        lambda x, u: 0.5 * (Q * ca.sumsqr(x - target) + R * ca.sumsqr(u)),
        lambda x: 0.5 * Qf * ca.sumsqr(x - target),
        x0,
        0.05,
        bounds,
    )


def cart_pole() -> Discretised:
    """ALTRO's cart-pole."""
    target = np.array([0.0, np.pi, 0.0, 0.0])
    return _tracking(robots.cart_pole()[0], target, 4 * [0.0], 0.01, 0.1, 100, (-3.0, 3.0))


def acrobot() -> Discretised:
    """ALTRO's acrobot."""
    target = np.array([np.pi / 2, 0.0, 0.0, 0.0])
    return _tracking(robots.acrobot()[0], target, -target, 1, 0.01, 100, (-15.0, 15.0))


def car_parking() -> Discretised:
    """Tassa's car; its costs are per step, and `Discretised` multiplies by dt."""
    dt = 0.03

    def z(x, width):
        return ca.sqrt(x**2 + width**2) - width

    def running(x, u):
        near = 1e-3 * (z(x[0], 0.1) + z(x[1], 0.1))
        return (1e-2 * (u[0] ** 2 + 0.01 * u[1] ** 2) + near) / dt

    def terminal(x):
        return 0.1 * (z(x[0], 0.01) + z(x[1], 0.01)) + z(x[2], 0.01) + 0.3 * z(x[3], 1.0)

    bounds = ([-0.5, -2.0], [0.5, 2.0])
    return _problem(robots.car(), running, terminal, [1, 1, 1.5 * np.pi, 0], dt, bounds)


def planar_quadrotor() -> Discretised:
    """The quadrotor; its costs are per step too."""
    goal, dt, weight = np.array([0.0, 1, 0, 0, 0, 0]), 0.05, 9.81

    def running(x, u):
        return 0.5 * (ca.sumsqr(x - goal) + 0.01 * ca.sumsqr(u - weight / 2)) / dt

    model = robots.planar_quadrotor()[0]
    bounds = (0.2 * weight, 0.6 * weight)
    start = [10, 2, 0, 0, 0, 0]
    return _problem(model, running, lambda x: 0.5 * ca.sumsqr(x - goal), start, dt, bounds)


def torque_arm() -> Discretised:
    """The torque arm's posture."""
    return _costed(models.torque_arm(), posture_cost([1.0, 1.5]), [1.5, 1.5, 0, 0], 0.01)


def muscle_arm(active_state: str) -> Discretised:
    """The muscle arm's posture."""
    x0 = [1.5, 1.5] + 8 * [0.0]
    return _costed(models.muscle_arm(active_state), posture_cost([1.0, 1.5]), x0, 0.01, (0.0, 1.0))


def chain(n: int) -> Discretised:
    """A chain of n rods, with a price on its rates."""
    cost = posture_cost(np.full(n, 0.3 + 0.4 / n), effort=0.01, slowness=0.01)
    x0 = np.r_[np.full(n, 0.3), np.zeros(n)]
    return _costed(models.chain(n, 0.05 * (2 / n) ** 3), cost, x0, 0.01)


LIBRARY = {
    "double-integrator": double_integrator,
    "double-integrator-bounded": partial(double_integrator, (-1.0, 1.0)),
    "pendulum": pendulum,
    "pendulum-bounded": partial(pendulum, (-3.0, 3.0)),
    "pendulum-2005": pendulum_2005,
    "cart-pole": cart_pole,
    "acrobot": acrobot,
    "car-parking": car_parking,
    "planar-quadrotor": planar_quadrotor,
    "torque-arm": torque_arm,
    "muscle-arm": partial(muscle_arm, "linear"),
    "muscle-arm-brown": partial(muscle_arm, "brown"),
    "chain-2": partial(chain, 2),
    "chain-4": partial(chain, 4),
    "chain-8": partial(chain, 8),
}


def from_afar(problem: Discretised, us: np.ndarray, about: np.ndarray) -> Outcome:
    """Start IPOPT from the roll-out of us (T, nu), far from an optimum, without multipliers.

    The program is scaled about the controls `about` (T, nu), near an optimum.
    """
    num_steps, nu = us.shape
    program = transcribe(problem, rollout(problem, about)[0], about)
    free = np.full(problem.x0.size, np.inf)
    bounds = (np.r_[problem.lower, -free], np.r_[problem.upper, free])
    lower, upper = (np.tile(bound / program.units, num_steps) for bound in bounds)
    start = pack(rollout(problem, us)[0], us, program.units)
    options = {"ipopt": PATIENCE, "print_time": False}
    solver = ca.nlpsol("solver", "ipopt", program.nlp, options)
    found = solver(x0=start, lbx=lower, ubx=upper, lbg=0, ubg=0)
    stats = solver.stats()
    controls = found["x"].full().reshape(num_steps, -1)[:, :nu] * program.units[:nu]
    return Outcome(stats["return_status"], stats["iter_count"], controls)
