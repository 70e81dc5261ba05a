"""Costs of one's own, wrappers that forward them, and numbers that do not fit."""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc
from jaxctrl.experiments._free_timing import ClosedPath, OnPath

TARGET = jnp.array([-0.1, 0.53])


@pytest.fixture(scope="module")
def arm():
    return jc.plants.TorqueArm()


@pytest.fixture(scope="module")
def x0(arm):
    return arm.at_rest(0.785, 1.571)


@eqx.filter_jit
def total_cost(problem, xs, us):
    return problem.total_cost(jnp.asarray(xs), jnp.asarray(us))


# Costs of one's own.


class Slowness(jc.AbstractRate):  # as in the docstring of `AbstractCost`
    weight: jax.Array
    of = "joints"

    def rate(self, plant, at):
        n = plant.num_joints
        return self.weight * jnp.sum(at.x[n : 2 * n] ** 2)


class Passing(jc.AbstractEvents):
    times: jax.Array
    of: ClassVar[str] = "hand"

    def event(self, plant, x, j):
        return (1 + j) * plant.hand(x)[0] ** 2


class Plain(jc.AbstractCost):
    """Written with functions of (x, u, t), as costs were before there were kinds."""

    def running(self, plant, x, u, t):
        return t * x[0] ** 2 + u[1] ** 2

    def terminal(self, plant, x):
        return 3.0 * x[2]

    @property
    def events(self):
        return (jc.Events(jnp.array([0.15]), lambda plant, x, j: x[1] + j),)


def test_a_cost_of_ones_own_is_added_to_a_task(arm, x0):
    task = jc.tasks.reach(arm, TARGET, 0.5, num_steps=10)
    problem = task + Slowness(jnp.array(0.3))
    xs, us = np.random.default_rng(0).normal(size=(11, 4)), np.zeros((10, 2))
    added = total_cost(problem, xs, us) - total_cost(task, xs, us)
    np.testing.assert_allclose(added, 0.05 * 0.3 * np.sum(xs[:-1, 2:] ** 2), rtol=1e-10)
    fast, slow = (jc.solve(p, jc.ILQR(), x0) for p in (task, problem))
    assert slow.status.ok
    assert jnp.sum(slow.xs[:, 2:] ** 2) < jnp.sum(fast.xs[:, 2:] ** 2)


def test_a_cost_written_with_functions_of_state_control_and_time_still_counts(arm):
    rng = np.random.default_rng(0)
    xs, us = rng.normal(size=(5, 4)), rng.normal(size=(4, 2))
    problem = jc.Problem(arm, Plain() + Plain(), num_steps=4, dt=0.1)
    wanted = 0.1 * np.sum(0.1 * np.arange(4) * xs[:-1, 0] ** 2 + us[:, 1] ** 2)
    wanted += 3.0 * xs[-1, 2] + (xs[1, 1] + xs[2, 1]) / 2
    np.testing.assert_allclose(total_cost(problem, xs, us), 2 * wanted, rtol=1e-12)


class Looks(jc.AbstractRate):
    """A rate that depends on all that it may look at, by a table among others."""

    table: jax.Array

    def rate(self, plant, at):
        assert at.after is None
        return self.table[at.i] + 10 * at.s + 100 * at.t + 1000 * at.dt


def test_a_rate_sees_its_step_its_time_and_the_part_of_the_movement_that_is_over(arm):
    table = np.random.default_rng(0).normal(size=7)
    problem = jc.Problem(arm, Looks(jnp.asarray(table)), num_steps=7, dt=0.3)  # 3 dt / dt < 3
    i = np.arange(7)
    wanted = table + 10 * i / 7 + 100 * 0.3 * i + 300
    got = problem.stage_costs(jnp.zeros((8, 4)), jnp.zeros((7, 2)))
    np.testing.assert_allclose(got, [*(0.3 * wanted), 0.0], rtol=1e-12)
    between = problem.running(jnp.zeros(4), jnp.zeros(2), 0.8)
    np.testing.assert_allclose(between, table[2] + 10 * 0.8 / 2.1 + 80 + 300, rtol=1e-12)


def half(name):
    return type("Half", (jc.AbstractCost,), {name: lambda self, *args: 0.0})()


@pytest.mark.parametrize(
    ("cost", "match"),
    [
        (lambda: half("rate"), r"^cost: for Half.rate to count, derive from jc.AbstractRate"),
        (lambda: half("running"), "^cost: Half wants .* has running; or derive it from some of jc"),
        (lambda: half("runing"), "^cost: Half wants .* has none"),
    ],
)
def test_a_cost_whose_methods_would_not_count_is_refused(arm, cost, match):
    with pytest.raises(TypeError, match=match):
        jc.Problem(arm, cost(), num_steps=2)


def test_a_cost_of_something_unknown_is_refused():
    class Odd(jc.AbstractRate):
        of = "hands"

        def rate(self, plant, at):
            return jnp.zeros(())

    with pytest.raises(ValueError, match=r"^Odd.of: one of \('effort'.* got 'hands'"):
        Odd()


@pytest.mark.parametrize(
    ("kind", "method", "match"),
    [
        (jc.AbstractRate, "rate", r"^Wrong.rate: returned \(2,\), wanted \(\)"),
        (jc.AbstractEnd, "end", r"^Wrong.end: returned \(2,\), wanted \(\)"),
        (jc.AbstractEvents, "event", r"^Wrong.event: returned \(2,\), wanted \(\)"),
    ],
)
def test_a_term_of_another_shape_is_refused_by_its_name(arm, x0, kind, method, match):
    members = {method: lambda self, *args: jnp.zeros(2), "times": jnp.array([0.1])}
    cost = type("Wrong", (kind,), members)()
    with pytest.raises(ValueError, match=match):
        jc.solve(jc.Problem(arm, cost, num_steps=20), jc.ILQR(), x0)


# Augmented plants.


def test_a_wrapper_forwards_rates_residuals_ends_and_events():
    arm = jc.plants.MuscleArm()
    path = ClosedPath(jnp.zeros(2), jnp.ones((1, 2, 2)))
    plant = OnPath(arm, path, turns=1.0, rate=2.0, fastest=9.0)
    rng = np.random.default_rng(0)
    xs, us = rng.uniform(0.1, 0.9, (5, 11)), rng.uniform(0.1, 0.9, (4, 7))
    grid = {"num_steps": 4, "dt": 0.1}
    change = jc.models.TorqueChange(1.0)
    torques = np.asarray(jax.jit(jax.vmap(arm.muscle_torque))(jnp.asarray(xs[:, :-1])))
    wanted = 0.5 * np.sum(np.diff(torques, axis=0) ** 2) / 0.1
    got = total_cost(jc.Problem(plant, jc.OfInner(change), **grid), xs, us)
    assert wanted > 1.0
    np.testing.assert_allclose(got, wanted, rtol=1e-10)
    via = jc.tasks.ViaPoints(jnp.ones((1, 2)), jnp.array([0.13]))
    cost = change + (jc.tasks.HandTarget(TARGET) + (jc.tasks.Effort(2.0) + via))
    wrapped = jc.Problem(plant, jc.OfInner(cost), **grid)
    alone = jc.Problem(arm, cost, **grid)
    np.testing.assert_allclose(
        total_cost(wrapped, xs, us), total_cost(alone, xs[:, :-1], us[:, :-1]), rtol=1e-12
    )
    assert [part.of for part in jc.parts(wrapped.cost)] == ["effort", "hand", "effort", "hand"]
    # The effort of an augmented plant is that of the body in it, wrapped or not.
    bare = jc.Problem(plant, jc.tasks.Effort(2.0), **grid)
    np.testing.assert_allclose(total_cost(bare, xs, us), 0.1 * np.sum(us[:, :-1] ** 2), rtol=1e-12)


def test_a_wrapper_hands_checks_on(arm, x0):
    plant = jc.plants.RateControlled(arm)
    disc = jc.OfInner(jc.tasks.Obstacle(arm.hand(x0), 0.02))
    with pytest.raises(ValueError, match=r"^x0: the hand starts inside the obstacle"):
        jc.solve(jc.Problem(plant, disc, num_steps=3), jc.ILQR(), plant.lift(x0))
    with pytest.raises(TypeError, match=r"^cost: OfInner wants an augmented plant, got TorqueArm"):
        jc.solve(jc.Problem(arm, disc, num_steps=3), jc.ILQR(), x0)
    np.testing.assert_array_equal(disc.marks.obstacles, [[*arm.hand(x0), 0.02]])


# Numbers that do not fit.


def _cost(arm):
    return (
        jc.tasks.HandTarget(TARGET)
        + jc.tasks.PostureTarget(jnp.ones(2))
        + jc.tasks.JointLimits(jnp.zeros(2), jnp.ones(2))
        + jc.tasks.Obstacle(jnp.ones(2), 0.02)
        + jc.tasks.HandPath(jnp.zeros((3, 2)))
        + jc.tasks.ViaPoints(jnp.zeros((2, 2)), jnp.array([0.1, 0.2]))
        + jc.models.TorqueChange(1e-7)
    )


EDITS = [
    (0, "position", jnp.zeros((8, 2)), r"\(8, 2\), wanted \(2,\)"),
    (0, "velocity", jnp.zeros((8, 2)), r"\(8, 2\), wanted \(\) or \(2,\)"),
    (0, "position_weight", jnp.ones(8), r"\(8,\), wanted \(\)"),
    (1, "angles", jnp.zeros((8, 2)), r"\(8, 2\), wanted \(2,\)"),
    (1, "angles", jnp.zeros(3), r"\(3,\), wanted \(2,\)"),
    (1, "weight", jnp.ones(2), r"\(2,\), wanted \(\)"),
    (2, "lower", jnp.zeros(()), r"\(\), wanted \(2,\)"),
    (3, "centre", jnp.zeros((3, 2)), r"\(3, 2\), wanted \(2,\)"),
    (3, "radius", jnp.ones(3), r"\(3,\), wanted \(\)"),
    (4, "points", jnp.zeros((8, 3, 2)), r"\(8, 3, 2\), wanted \(m, 2\)"),
    (4, "weight", jnp.ones(3), r"\(3,\), wanted \(\)"),
    (5, "times", jnp.zeros(3), r"\(3,\), wanted \(2,\)"),
    (5, "weight", jnp.ones(3), r"\(3,\), wanted \(\) or \(2,\)"),
    (6, "weight", jnp.ones(2), r"\(2,\), wanted \(\)"),
]


def _edited(problem, index, name, value):
    def where(p):
        return getattr(jc.parts(p.cost)[index], name)

    return eqx.tree_at(where, problem, value)


@pytest.mark.parametrize(("index", "name", "value", "match"), EDITS)
def test_a_batch_of_numbers_put_in_without_vmap_is_refused_by_name(
    arm, x0, index, name, value, match
):
    problem = jc.Problem(arm, _cost(arm), num_steps=30)
    part = type(jc.parts(problem.cost)[index]).__name__
    edited = _edited(problem, index, name, value)
    match = rf"^{part}.{name}: got shape {match}; a batch of problems goes through jax.vmap"
    with pytest.raises(ValueError, match=match):
        jc.solve(edited, jc.ILQR(), x0)
    with pytest.raises(ValueError, match=match):
        edited.total_cost(jnp.zeros((31, 4)), jnp.zeros((30, 2)))
    with pytest.raises(ValueError, match=match):
        jax.jit(lambda v: jc.solve(_edited(problem, index, name, v), jc.ILQR(), x0).cost)(value)


@pytest.mark.parametrize(
    ("index", "name", "value"),
    [
        (0, "velocity_weight", -0.1), (1, "weight", -1.0), (2, "weight", -1.0),
        (3, "radius", -0.02), (3, "weight", -1e-8), (4, "terminal_weight", -1.0),
        (5, "weight", [1.0, -1.0]), (6, "weight", -1e-7),
    ],
)  # fmt: skip
def test_a_negative_weight_or_radius_is_refused_when_made_and_when_solved(
    arm, x0, index, name, value
):
    problem = jc.Problem(arm, _cost(arm), num_steps=30)
    part = jc.parts(problem.cost)[index]
    match = rf"^{type(part).__name__}.{name}: at least 0 is wanted, got "
    fields = {f.name: getattr(part, f.name) for f in dataclasses.fields(part)}
    with pytest.raises(ValueError, match=match):
        type(part)(**{**fields, name: value})
    with pytest.raises(ValueError, match=match):
        jc.solve(_edited(problem, index, name, jnp.asarray(value)), jc.ILQR(), x0)


def test_what_is_not_a_number_is_refused_when_made():
    with pytest.raises(ValueError, match=r"^Obstacle.centre: finite numbers are wanted"):
        jc.tasks.Obstacle([jnp.nan, 0.0], 0.02)
    with pytest.raises(ValueError, match=r"^Obstacle.radius: finite numbers are wanted"):
        jc.tasks.Obstacle([0.1, 0.0], jnp.nan)
    with pytest.raises(ValueError, match=r"^Effort.weight: at least 0 is wanted"):
        jc.tasks.Effort([[1.0, 0.0], [0.0, -1.0]])
    jc.tasks.Effort([[1.0, -0.5], [-0.5, 1.0]])  # off the diagonal any sign will do


def test_a_batch_put_in_under_vmap_is_many_problems(arm, x0):
    problem = jc.tasks.reach(arm, TARGET, 0.5, num_steps=5)
    us, targets = jnp.ones((5, 2)), jnp.stack([TARGET, -TARGET])
    xs = problem.rollout(x0, us)

    def cost(target):
        return _edited(problem, 0, "position", target).total_cost(xs, us)

    np.testing.assert_allclose(jax.vmap(cost)(targets), [cost(t) for t in targets], rtol=1e-12)


# One owner for every number.


def test_another_time_step_stretches_a_tracked_path(arm, x0):
    path = np.random.default_rng(0).normal(size=(4, 2)) * 0.1
    task = jc.tasks.track(arm, path, 0.5, num_steps=10)
    edited = eqx.tree_at(lambda p: p.dt, task, jnp.array(0.08))
    anew = jc.Problem(arm, task.cost, num_steps=10, dt=0.08)
    xs, us = np.random.default_rng(1).normal(size=(11, 4)), np.zeros((10, 2))
    hands = np.asarray(jax.vmap(arm.hand)(jnp.asarray(xs)))
    s = np.linspace(0, 1, 11)
    on = np.stack([np.interp(s, np.linspace(0, 1, 4), column) for column in path.T], axis=1)
    squares = np.sum((hands - on) ** 2, axis=1)
    wanted = 10.0 * (0.08 * squares[:-1].sum() + 0.05 * squares[-1])
    np.testing.assert_allclose(total_cost(edited, xs, us), wanted, rtol=1e-12)
    np.testing.assert_allclose(total_cost(anew, xs, us), wanted, rtol=1e-12)


def test_another_time_step_is_the_cars_too():
    car = jc.plants.Car()
    cost, us = jc.QuadraticCost(R=1.0), jnp.tile(jnp.array([0.2, 1.0]), (10, 1))
    x0 = car.at_rest([0.0, 0.0], 0.3)
    one = jc.Problem(car, cost, num_steps=10, dt=0.03)
    edited = eqx.tree_at(lambda p: p.dt, one, jnp.array(0.1))
    np.testing.assert_allclose(edited.rollout(x0, us)[-1, 3], 1.0, rtol=1e-12)  # a T
    np.testing.assert_array_equal(
        edited.rollout(x0, us), jc.Problem(car, cost, num_steps=10, dt=0.1).rollout(x0, us)
    )
