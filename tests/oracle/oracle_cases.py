"""The problems that are put to both solvers, each written twice."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import casadi as ca
import casadi_models as models
import numpy as np
from nlp import Discretised

import jaxctrl as jc

INF = float("inf")
FREE = (-INF, INF)


class Case(NamedTuple):
    """A problem for jaxctrl, its start x0 (nx,), and the same for CasADi."""

    problem: jc.Problem
    x0: np.ndarray
    oracle: Discretised


class Cost(NamedTuple):
    """terminal(x) + int (effort |u|^2 + slowness |dq|^2)/2 dt, in CasADi; dq are n rates."""

    terminal: Callable[[ca.SX], ca.SX]
    effort: float
    n: int = 1
    slowness: float = 0.0

    def functions(self, nx: int, nu: int) -> tuple[ca.Function, ca.Function]:
        """Return running(x, u) and terminal(x)."""
        x, u = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
        dq = x[self.n : 2 * self.n]
        rate = 0.5 * (self.effort * ca.sumsqr(u) + self.slowness * ca.sumsqr(dq))
        return (
            ca.Function("running", [x, u], [rate]),
            ca.Function("terminal", [x], [self.terminal(x)]),
        )


def _case(problem: jc.Problem, x0, bounds, model: models.Model, cost: Cost, duration) -> Case:
    """Put bounds (lower, upper), or None, on a problem, and pair it with its double."""
    plant, num_steps = problem.plant, problem.num_steps
    problem = jc.Problem(
        plant, problem.cost, num_steps=num_steps, dt=problem.dt, control_bounds=bounds
    )
    lower, upper = (np.full(plant.nu, bound) for bound in bounds or FREE)
    running, terminal = cost.functions(plant.nx, plant.nu)
    x0 = np.asarray(x0)
    oracle = Discretised(model, running, terminal, x0, duration / num_steps, lower, upper)
    return Case(problem, x0, oracle)


def posture_cost(angles, effort=1e-4, slowness=0.0) -> Cost:
    """Return |q - q*|^2/2 + |dq|^2/2 at the end, with the efforts."""
    n = len(angles)

    def terminal(x):
        return 0.5 * (ca.sumsqr(x[:n] - angles) + ca.sumsqr(x[n : 2 * n]))

    return Cost(terminal, effort, n, slowness)


def reach_cost(model: models.Model, target, effort=1e-4) -> Cost:
    """Return |e - e*|^2 + 0.01 |de/dt|^2 at the end, with the effort."""

    def terminal(x):
        position, velocity = model.hand(x)
        return ca.sumsqr(position - target) + 0.01 * ca.sumsqr(velocity)

    return Cost(terminal, effort)


def swing_up(bounds=None) -> Case:
    """Swing the pendulum up within 4 s."""
    problem = jc.tasks.swing_up(jc.plants.Pendulum(), 4.0, num_steps=400)
    cost = Cost(lambda x: 0.5 * ca.sumsqr(x), effort=1e-5)
    return _case(problem, [np.pi, 0.0], bounds, models.pendulum(), cost, 4.0)


def torque_posture(bounds=None) -> Case:
    """Bring the torque arm from (1.5, 1.5) to (1, 1.5) rad within 0.5 s."""
    angles = [1.0, 1.5]
    problem = jc.tasks.posture(jc.plants.TorqueArm(), angles, 0.5)
    x0 = [1.5, 1.5, 0.0, 0.0]
    return _case(problem, x0, bounds, models.torque_arm(), posture_cost(angles), 0.5)


def torque_reach(bounds=None) -> Case:
    """Move the torque arm's hand by 10 cm to the right within 0.5 s."""
    model = models.torque_arm()
    x0 = [np.pi / 4, np.pi / 2, 0.0, 0.0]
    target = model.hand(x0)[0].full().ravel() + np.array([0.10, 0.0])
    problem = jc.tasks.reach(jc.plants.TorqueArm(), target, 0.5)
    return _case(problem, x0, bounds, model, reach_cost(model, target), 0.5)


def muscle_posture(bounds=(0.0, 1.0), duration=0.5, active_state="linear") -> Case:
    """Bring the muscle arm from (1.5, 1.5) to (1, 1.5) rad in 50 steps."""
    angles, arm = [1.0, 1.5], jc.plants.MuscleArm(active_state=active_state)
    problem = jc.tasks.posture(arm, angles, duration, num_steps=50)
    x0, model = [1.5, 1.5] + 8 * [0.0], models.muscle_arm(active_state)
    return _case(problem, x0, bounds, model, posture_cost(angles), duration)


def muscle_reach(bounds=(0.0, 1.0), duration=0.5, active_state="linear") -> Case:
    """Move the muscle arm's hand by (-8, 8) cm in 50 steps."""
    model = models.muscle_arm(active_state)
    arm = jc.plants.MuscleArm(active_state=active_state)
    x0 = [0.785, 1.571] + 8 * [0.0]
    target = model.hand(x0)[0].full().ravel() + np.array([-0.08, 0.08])
    problem = jc.tasks.reach(arm, target, duration, num_steps=50)
    return _case(problem, x0, bounds, model, reach_cost(model, target), duration)


def chain_posture(bounds=None, num_steps=50, friction=2e-3, slowness=1e-4) -> Case:
    """Turn each joint of eight links by 0.14 rad within 0.5 s.

    The fastest mode decays at 43/s with this friction and at 1070/s with the plant's default of
    0.05, for which the Euler method needs steps below 1.9 ms. Without the price on rates
    (slowness [s/rad^2]) the cheapest movement whips the light links about at 50 to 100 rad/s,
    which neither grid resolves.
    """
    angles = 0.3 + np.full(8, 0.4 / np.sqrt(8))
    plant = jc.plants.Chain(8, friction=friction)
    posture = jc.tasks.posture(plant, angles, 0.5, num_steps=num_steps)
    rates = jc.QuadraticCost(Q=np.r_[np.zeros(8), np.full(8, slowness)])
    problem = jc.Problem(plant, posture.cost + rates, num_steps=num_steps, dt=posture.dt)
    x0 = np.r_[np.full(8, 0.3), np.zeros(8)]
    cost = posture_cost(angles, slowness=slowness)
    return _case(problem, x0, bounds, models.chain(8, friction), cost, 0.5)


QUICK = {
    "pendulum_swing_up": swing_up,
    "pendulum_swing_up_within_3Nm": partial(swing_up, (-3.0, 3.0)),
    "torque_arm_posture": torque_posture,
    "torque_arm_posture_within_1.3Nm": partial(torque_posture, (-1.3, 1.3)),
    "torque_arm_posture_within_1Nm": partial(torque_posture, (-1.0, 1.0)),
    "muscle_arm_posture": muscle_posture,
    "muscle_arm_posture_in_350ms": partial(muscle_posture, duration=0.35),
    "muscle_arm_reach": muscle_reach,
    "muscle_arm_reach_in_200ms": partial(muscle_reach, duration=0.2),
    "browns_muscle_arm_posture": partial(muscle_posture, active_state="brown"),
    "browns_muscle_arm_reach": partial(muscle_reach, active_state="brown"),
    "chain_posture": chain_posture,
    "chain_posture_within_2Nm": partial(chain_posture, (-2.0, 2.0)),
}
"""Cases of a few seconds each. Half of the peak torque is 1 N m in the arm's posture, 0.44 N m in
its reach, and 1.3 N m in the chain's posture."""

SLOW = {
    "torque_arm_reach": torque_reach,
    "torque_arm_reach_within_0.44Nm": partial(torque_reach, (-0.44, 0.44)),
    "muscle_arm_posture_without_bounds": partial(muscle_posture, FREE),
    "muscle_arm_reach_without_bounds": partial(muscle_reach, FREE),
    "muscle_arm_reach_in_250ms": partial(muscle_reach, duration=0.25),
    "chain_posture_within_1.3Nm": partial(chain_posture, (-1.3, 1.3)),
    "chain_posture_of_1ms_steps": partial(chain_posture, num_steps=500, friction=0.05),
    "chain_posture_of_1ms_steps_within_2Nm": partial(
        chain_posture, (-2.0, 2.0), num_steps=500, friction=0.05
    ),
}
"""Cases that take longer, or repeat a plant and a cost."""

HARD = {
    "muscle_arm_reach_in_150ms": partial(muscle_reach, duration=0.15),
    "muscle_arm_posture_in_200ms": partial(muscle_posture, duration=0.2),
    "chain_posture_at_any_rate": partial(chain_posture, slowness=0.0),
    "chain_posture_of_1ms_steps_at_any_rate": partial(
        chain_posture, num_steps=500, friction=0.05, slowness=0.0
    ),
}
"""Cases with many local optima; they are tabulated and nothing is claimed of them."""
