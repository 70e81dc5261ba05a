"""Models, comparisons and free times with costs and plants of one's own."""

import ast
import inspect
import pkgutil
from pathlib import Path
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc
from jaxctrl.models import MinimumEnergy, MinimumJerk, MinimumTorqueChange
from jaxctrl.models._models import goals

TARGET = jnp.array([-0.1, 0.53])
STEPS = 10


class Left(jc.AbstractRate):
    """A price on being right of a line, which asks for the hand alone."""

    weight: jax.Array
    of: ClassVar[str] = "hand"

    def rate(self, plant, at):
        return self.weight * jnp.maximum(plant.hand(at.x)[0] + 0.05, 0.0) ** 2

    @property
    def marks(self):
        return jc.tasks.Marks(points=jnp.array([0.05, 0.45]), obstacles=[[0.3, 0.3, 0.02]])


class Stiffness(jc.AbstractRate):
    """A price on torques and rates of joints, written for an arm of torques."""

    weight: jax.Array

    def rate(self, plant, at):
        return self.weight * jnp.sum(at.u**2) + jnp.sum(at.x[2:] ** 2)


class Passing(jc.AbstractEvents):
    """A price on not passing zero at times of one's own."""

    times: jax.Array

    def event(self, plant, x, j):
        return 10 * (x[0] - 0.3) ** 2


@pytest.fixture(scope="module")
def arm():
    return jc.plants.TorqueArm()


@pytest.fixture(scope="module")
def x0(arm):
    return arm.at_rest(0.785, 1.571)


@pytest.fixture(scope="module")
def reach(arm):
    return jc.tasks.reach(arm, TARGET, 0.5, num_steps=STEPS)


@eqx.filter_jit
def cost_of(problem, xs, us):
    return problem.total_cost(jnp.asarray(xs), jnp.asarray(us))


def test_a_model_keeps_a_cost_of_ones_own_as_it_is_for_the_tasks_plant(reach):
    rng = np.random.default_rng(0)
    xs, us = rng.normal(size=(STEPS + 1, 6)), rng.normal(size=(STEPS, 2))
    model, own = MinimumTorqueChange(), Stiffness(jnp.array(0.3))
    added = cost_of(model.problem(reach + own), xs, us) - cost_of(model.problem(reach), xs, us)
    # The torques are states there, and what was written for torques is not of their rates.
    wanted = 0.05 * np.sum(0.3 * xs[:-1, 4:] ** 2 + xs[:-1, 2:4] ** 2)
    np.testing.assert_allclose(added, wanted, rtol=1e-10)


def test_a_model_puts_its_own_effort_in_the_place_of_ones_own(reach):
    class Own(jc.AbstractRate):
        of: ClassVar[str] = "effort"

        def rate(self, plant, at):
            return jnp.sum(at.u**4)

    assert [type(goal).__name__ for goal in goals(reach + Own())] == ["HandTarget"]
    xs, us = jnp.ones((STEPS + 1, 4)), jnp.full((STEPS, 2), 3.0)
    problem = MinimumEnergy(0.7).problem(reach + Own())
    end = reach.total_cost(xs, 0 * us)
    np.testing.assert_allclose(cost_of(problem, xs, us), end + 0.25 * 0.7 * 18, rtol=1e-12)


def test_a_hand_alone_keeps_what_is_of_the_hand_and_drops_what_is_of_the_joints(reach):
    class Slowness(jc.AbstractRate):
        of: ClassVar[str] = "joints"

        def rate(self, plant, at):
            return jnp.sum(at.x[plant.num_joints :] ** 2)

    task = jc.tasks.limit_joints(reach, -1.0, 2.0) + Left(jnp.array(2.0)) + Slowness()
    problem = MinimumJerk(1e-8).problem(task)
    names = [type(part).__name__ for part in jc.parts(problem.cost)]
    assert names == ["HandTarget", "Left", "PolynomialJerkCost"]
    xs = jnp.zeros((STEPS + 1, 6)).at[:, 0].set(0.15)
    added = problem.running(xs[0], jnp.zeros(6), 0.0)
    np.testing.assert_allclose(added, 2.0 * 0.2**2, rtol=1e-12)


def test_a_hand_alone_refuses_what_it_cannot_have_and_says_how(reach):
    with pytest.raises(TypeError, match=r"^task: minimum jerk .* has no Stiffness; .*`of = \"hand"):
        MinimumJerk().problem(reach + Stiffness(jnp.array(1.0)))

    class Elbow(jc.AbstractEnd):
        of: ClassVar[str] = "hand"

        def end(self, plant, x):
            return x[plant.num_joints]

    with pytest.raises(TypeError, match=r'^task: Elbow says `of = "hand"`, but .*num_joints'):
        MinimumJerk().problem(reach + Elbow())


def test_models_are_compared_on_a_task_with_a_cost_of_ones_own(reach, x0):
    task = reach + Left(jnp.array(1.0))
    comparison = jc.compare((MinimumEnergy(), MinimumJerk(1e-8)), task, x0, jc.ILQR())
    plain = jc.compare((MinimumEnergy(), MinimumJerk(1e-8)), reach, x0, jc.ILQR())
    assert comparison.ok
    # Both begin 3 cm right of the line, and leave that side earlier than without it.
    beyond = [np.maximum(c.hands[..., 0] + 0.05, 0).sum(axis=1) for c in (comparison, plain)]
    assert (beyond[0] < 0.99 * beyond[1]).all(), beyond
    figure = comparison.figure()
    discs = [patch for patch in figure.axes[0].patches if hasattr(patch, "radius")]
    assert any(np.isclose(disc.radius, 2.0) for disc in discs)  # cm


def test_a_start_of_a_plant_that_has_its_torques_as_states_already_stays(arm, x0):
    plant = jc.plants.RateControlled(arm)
    task = jc.tasks.reach(plant, TARGET, 0.5, num_steps=STEPS)
    begin = plant.lift(x0, 0.3)
    np.testing.assert_array_equal(MinimumTorqueChange().start(task, begin), begin)
    assert MinimumTorqueChange().problem(task).plant is plant


def test_free_times_are_those_of_ones_own_events_on_ones_own_plant():
    plant = jc.FunctionPlant(lambda x, u, t: jnp.array([x[1], u[0]]), nx=2, nu=1)
    cost = jc.QuadraticCost(R=0.1, Qf=10.0, target=jnp.array([1.0, 0.0]))
    problem = jc.Problem(plant, cost + Passing(jnp.array([0.21])), num_steps=20, dt=0.05)
    found = jc.optimise_times(problem, jc.ILQR(), jnp.zeros(2), passing=True)
    assert found.ok, found
    x = found.solution.xs[:, 0]
    # The best time is the one at which it is there anyhow, so that the event costs nothing.
    np.testing.assert_allclose(np.interp(found.times[0], problem.ts, x), 0.3, atol=2e-3)
    alone = jc.solve(jc.Problem(plant, cost, num_steps=20, dt=0.05), jc.ILQR(), jnp.zeros(2))
    np.testing.assert_allclose(found.value, alone.cost, rtol=1e-4)
    both = jc.optimise_times(problem, jc.ILQR(), jnp.zeros(2), duration=(0.8, 2.0), price=0.3)
    assert both.ok and both.duration != 1.0 and both.times == 0.21


def test_free_times_of_a_discrete_plant_are_refused():
    plant = jc.FunctionPlant(lambda x, u, t: x + u, nx=1, nu=1, discrete=True)
    problem = jc.Problem(plant, jc.QuadraticCost(R=1.0), num_steps=5)
    with pytest.raises(ValueError, match=r"^problem: one of a continuous plant .*FunctionPlant"):
        jc.optimise_times(problem, jc.ILQR(), jnp.zeros(1), duration=(0.1, 1.0))


def _concrete_costs():
    found = set()
    for info in pkgutil.walk_packages(jc.__path__, "jaxctrl."):
        if not info.name.endswith(("__main__", "cli")):
            module = __import__(info.name, fromlist=["_"])
            for name, value in vars(module).items():
                if inspect.isclass(value) and issubclass(value, jc.AbstractCost):
                    found.add(name)
    return {name for name in found if not name.startswith("Abstract")}


def test_models_ask_no_cost_for_its_class():
    concrete = _concrete_costs()
    assert {"Effort", "HandPath", "OfInner", "SumCost"} <= concrete
    for path in Path(jc.models.__path__[0]).glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "isinstance":
                asked = {n.id for n in ast.walk(node.args[1]) if isinstance(n, ast.Name)}
                assert not asked & concrete, f"{path.name}, line {node.lineno}"
