"""Derivatives through a solve, against re-solved finite differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import PROBLEMS, with_bounds

import jaxctrl as jc

TIGHT = jc.DDP(gradient_tolerance=1e-9)


def _with(name, bounds):
    problem, x0 = PROBLEMS[name]()
    return with_bounds(problem, bounds), x0


def _by_name(name):
    return PROBLEMS[name]()


def _active(bounds):
    """Return a problem whose muscles neither start at rest nor get there.

    At u = a the activation's time constant jumps, at v = 0 the slope of the force-velocity curve:
    an optimum there has a derivative on either side. The effort is dear, or the weights of the
    goal would hardly count.
    """
    arm = jc.plants.MuscleArm()
    problem = jc.tasks.posture(arm, jnp.array([1.0, 1.7]), 0.5, effort=0.1)
    x0 = arm.at_rest(shoulder=0.785, elbow=1.571)
    return with_bounds(problem, bounds), x0.at[2:].set(jnp.array([0.3, -0.2] + 6 * [0.05]))


# Few active bounds and many.
CASES = {
    "pendulum": lambda: _by_name("pendulum"),
    "pendulum, few bounds": lambda: _with("pendulum", (-8.0, 8.0)),
    "pendulum, many bounds": lambda: _with("pendulum", (-3.0, 3.0)),
    "torque arm, reach": lambda: _by_name("torque arm, reach"),
    "torque arm, few bounds": lambda: _with("torque arm, reach", (-1.0, 1.0)),
    "torque arm, many bounds": lambda: _with("torque arm, reach", (-0.4, 0.4)),
    "torque arm, via": lambda: _by_name("torque arm, via"),
    "muscle arm, few bounds": lambda: _active((0.01, 1.0)),
    "muscle arm, many bounds": lambda: _active((0.03, 0.2)),
    "chain of 4": lambda: _by_name("chain of 4"),
    "chain of 4, few bounds": lambda: _with("chain of 4", (-0.5, 0.5)),
    "chain of 4, many bounds": lambda: _with("chain of 4", (-0.2, 0.2)),
}
QUICK = ["pendulum, many bounds"]


def _check(name, where=None):
    problem, x0 = CASES[name]()
    report = jc.check_gradients(problem, TIGHT, x0, where=where)
    print(name, report, sep="\n")
    for row in report.rows:
        # What is not above the differences' own uncertainty says nothing.
        assert row.error <= max(1e-5, 10 * row.uncertainty), row
        # Where terms a thousand times larger cancel, as in a chain's last state, digits are lost.
        assert row.transposed <= 1e-9, row
    reliable = [row for row in report.rows if row.uncertainty <= 1e-6]
    assert len(reliable) >= 0.9 * len(report.rows)


@pytest.mark.parametrize("name", QUICK)
def test_derivatives_by_every_input_agree_with_differences(name):
    _check(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in CASES if name not in QUICK])
def test_derivatives_by_every_input_agree_with_differences_everywhere(name):
    _check(name)


def test_derivatives_by_times_of_events_and_points_agree_with_differences():
    _check("torque arm, via", lambda name: name.endswith((".times", ".points", "I2")))


@pytest.fixture(scope="module")
def pendulum():
    problem, x0 = CASES["pendulum, many bounds"]()

    @jax.jit
    def solve(mass, x0):
        changed = eqx.tree_at(lambda p: p.plant.m, problem, mass)
        return jc.solve(changed, TIGHT, x0)

    return problem, x0, solve


def test_bounds_that_bind_move_their_controls(pendulum):
    problem, x0, _ = pendulum

    def us(upper):
        return jc.solve(with_bounds(problem, (-3.0, upper)), TIGHT, x0).us

    upper = jnp.array(3.0)
    value, slope = us(upper), jax.jacfwd(us)(upper)
    held = value == upper
    assert held.any()
    np.testing.assert_array_equal(slope[held], 1.0)


def test_gradients_under_vmap_equal_those_of_each_lane(pendulum):
    _, x0, solve = pendulum
    masses = jnp.array([0.95, 1.0, 1.1])

    def loss(mass, x0):
        solution = solve(mass, x0)
        return jnp.sum(solution.us**2) + solution.cost

    slope = jax.jit(jax.grad(loss, argnums=(0, 1)))
    batch = jax.jit(jax.vmap(jax.grad(loss, argnums=(0, 1)), in_axes=(0, None)))(masses, x0)
    for lane, mass in enumerate(masses):
        for got, wanted in zip(batch, slope(mass, x0), strict=True):
            np.testing.assert_allclose(got[lane], wanted, rtol=1e-8)


def test_second_derivatives_of_the_cost_are_differences_of_first_ones(pendulum):
    problem, x0, solve = pendulum
    slope = jax.jit(jax.grad(lambda x0: solve(problem.plant.m, x0).cost))
    hessian = jax.jit(jax.jacfwd(jax.grad(lambda x0: solve(problem.plant.m, x0).cost)))(x0)
    h = 1e-5
    wanted = [(slope(x0 + h * e) - slope(x0 - h * e)) / (2 * h) for e in jnp.eye(2)]
    np.testing.assert_allclose(hessian, jnp.stack(wanted), rtol=1e-5, atol=1e-6)


def _unfinished(problem, x0, max_steps=1):
    return jc.solve(problem, jc.ILQR(), x0, max_steps=max_steps)


def test_a_solve_that_did_not_converge_has_nan_derivatives():
    problem, x0 = PROBLEMS["pendulum"]()
    for output in (lambda s: s.us, lambda s: s.xs[1:], lambda s: s.cost):
        slope = jax.jacfwd(lambda x0, output=output: output(_unfinished(problem, x0)))(x0)
        assert jnp.isnan(slope).all()
    slope = jax.grad(lambda x0: _unfinished(problem, x0).cost)(x0)
    assert jnp.isnan(slope).all()


def test_zero_cotangents_give_exact_zero_through_failed_solves():
    problem, x0 = PROBLEMS["pendulum"]()

    def loss(x0):
        solution = _unfinished(problem, x0)
        ignored = jnp.where(solution.status.ok, solution.cost, 0.0)
        return ignored + jnp.where(solution.status.ok, solution.us.sum(), 0.0)

    np.testing.assert_array_equal(jax.grad(loss)(x0), 0.0)


def test_one_failed_lane_leaves_the_gradient_of_a_batch_alone():
    def dynamics(x, u, t, p):
        return jnp.array([x[1], p * x[0] ** 3 + u[0]])  # escapes from far away

    def loss(p, starts):
        plant = jc.FunctionPlant(dynamics, nx=2, nu=1, params=p)
        problem = jc.Problem(plant, jc.QuadraticCost(R=0.1, Qf=1.0), num_steps=20, dt=0.05)
        solutions = jax.vmap(lambda x0: jc.solve(problem, TIGHT, x0))(starts)
        ok = solutions.status.ok
        return jnp.sum(jnp.where(ok, solutions.cost + solutions.us.sum((1, 2)), 0.0)), ok

    p, good = jnp.array(1.0), jnp.array([[0.5, 0.0], [-0.3, 0.2]])
    for bad in ([1e60, 1e60], [jnp.nan, 0.0]):
        starts = jnp.concatenate([good, jnp.array([bad])])
        slope, ok = jax.grad(loss, has_aux=True)(p, starts)
        assert ok.tolist() == [True, True, False]
        np.testing.assert_allclose(slope, jax.grad(loss, has_aux=True)(p, good)[0], rtol=1e-9)


def test_float32_derivatives_agree_with_float64_to_one_per_cent():
    def slope(dtype):
        problem, x0 = PROBLEMS["torque arm, reach"]()
        problem, x0 = jax.tree.map(
            lambda leaf: leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf, (problem, x0)
        )
        mass = problem.plant.skeleton.m2

        def loss(mass, x0):
            changed = eqx.tree_at(lambda p: p.plant.skeleton.m2, problem, mass)
            solution = jc.solve(changed, jc.DDP(), x0)
            return jnp.sum(solution.us**2)

        return jax.grad(loss, argnums=(0, 1))(mass, x0)

    wanted = slope(jnp.float64)
    with jax.enable_x64(False):
        got = slope(jnp.float32)
    for a, b in zip(got, wanted, strict=True):
        assert a.dtype == jnp.float32
        np.testing.assert_allclose(a, b, rtol=1e-2, atol=1e-2 * float(jnp.abs(b).max()))


def test_a_control_that_just_meets_its_bound_is_compared_on_the_side_that_it_follows():
    # The last force moves nothing but the velocity, which is free: 0 is its optimum, and its bound.
    plant = jc.FunctionPlant(lambda x, u, t: jnp.array([x[1], u[0]]), nx=2, nu=1)
    cost = jc.QuadraticCost(R=0.1, Qf=jnp.array([1.0, 0.0]))
    bounds = (jnp.zeros(1), jnp.full(1, 9.0))
    problem = jc.Problem(plant, cost, num_steps=20, dt=0.05, control_bounds=bounds)
    report = jc.check_gradients(problem, TIGHT, [-1.0, 0.0], where=lambda name: "bounds" in name)
    lower = [row for row in report.rows if row.name.endswith("[0]") and row.output == "us"]
    # With a multiplier of zero it counts as free or as held, with one derivative of each.
    assert [row.side for row in lower] in (["+"], ["-"]) and lower[0].error < 1e-6


def test_checks_in_float32_are_refused():
    with jax.enable_x64(False):
        problem, x0 = PROBLEMS["pendulum"]()
        with pytest.raises(ValueError, match="got float32, wanted float64"):
            jc.check_gradients(problem, jc.DDP(), x0)
