"""Policies that recede with the horizon, and as the start of a solve: `us=policy`."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc

T = 40


def pendulum(x, u, t):
    return jnp.stack([x[1], 9 * jnp.sin(x[0]) + u[0]])


def balance(num_steps=T):
    plant = jc.FunctionPlant(pendulum, nx=2, nu=1)
    return jc.Problem(plant, jc.QuadraticCost(Q=1.0, R=0.1), num_steps=num_steps, dt=0.05)


X0 = np.array([0.3, 0.0])


@pytest.fixture(scope="module")
def solution():
    solution = jc.solve(balance(), jc.ILQR(), X0)
    assert solution.status.ok
    return solution


def test_a_shifted_policy_drops_its_first_steps_and_holds_its_last(solution):
    policy = solution.policy
    for n in (0, 1, 7, T, np.int64(3)):
        moved = policy.shifted(n)
        for name in ("us", "k", "K"):
            rows = np.asarray(getattr(policy, name))
            want = np.concatenate([rows[n:], np.repeat(rows[-1:], n, 0)])
            np.testing.assert_array_equal(getattr(moved, name), want)
        xs = np.asarray(policy.xs)
        want = np.concatenate([xs[n:], np.repeat(xs[-1:], n, 0)])
        np.testing.assert_array_equal(moved.xs, want)
        assert moved.dt == policy.dt and moved.bounds is None
    rising = (-1.0 - np.arange(T)[:, None], jnp.full((T, 1), jnp.inf))
    moved = dataclasses.replace(policy, bounds=rising).shifted(2)
    np.testing.assert_array_equal(moved.bounds[0][:, 0], [*range(-3, -T - 1, -1), -T, -T])
    np.testing.assert_array_equal(moved.bounds[1], np.inf)


def test_a_shifted_policy_continues_the_run_that_it_came_from(solution):
    """Started where the first run is after n steps, it repeats the rest of it."""
    start = X0 + np.array([0.05, 0.1])
    whole = jc.simulate(balance(), solution.policy, start)
    rest = jc.simulate(balance(), solution.policy.shifted(6), whole.xs[6])
    np.testing.assert_allclose(rest.us[:-6], whole.us[6:], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(rest.xs[:-6], whole.xs[6:], rtol=1e-9, atol=1e-12)


def test_shifts_that_do_not_fit_are_named(solution):
    for n in (-1, T + 1):
        with pytest.raises(ValueError, match=rf"n: 0 to {T} steps are wanted, got {n}"):
            solution.policy.shifted(n)
    with pytest.raises(TypeError, match=r"n: an integer is wanted, got 1\.5"):
        solution.policy.shifted(1.5)
    batch = jax.tree.map(lambda a: jnp.stack([a, a]), solution.policy)
    with pytest.raises(ValueError, match=r"us: got shape \(2, 40, 1\).*jax.vmap"):
        batch.shifted(1)
    one = jax.tree.map(lambda a: a[1], jax.vmap(lambda p: p.shifted(2))(batch))
    np.testing.assert_array_equal(one.K, solution.policy.shifted(2).K)


def test_a_solve_from_a_policy_is_one_from_its_controls_in_closed_loop(solution):
    start = X0 + np.array([0.1, -0.2])
    us = jc.simulate(balance(), solution.policy, start).us
    want = jc.solve(balance(), jc.ILQR(), start, us)
    got = jc.solve(balance(), jc.ILQR(), start, us=solution.policy)
    np.testing.assert_array_equal(got.history.cost, want.history.cost)
    np.testing.assert_array_equal(got.us, want.us)
    traced = jax.jit(lambda x, policy: jc.solve(balance(), jc.ILQR(), x, us=policy).us)
    np.testing.assert_allclose(traced(start, solution.policy), want.us, rtol=1e-9, atol=1e-12)
    again = jc.solve(balance(), jc.ILQR(), X0, us=solution.policy)
    assert again.status.ok and again.num_steps == 0


def test_batches_start_from_one_policy_or_from_one_each(solution):
    starts = np.array([X0, X0 + 0.1, X0 - 0.1])
    each = [jc.solve(balance(), jc.ILQR(), x, us=solution.policy) for x in starts]
    shared = jc.solve_batch(balance(), jc.ILQR(), starts, solution.policy)
    np.testing.assert_allclose(shared.us, [one.us for one in each], rtol=1e-9, atol=1e-9)
    own = jc.solve_batch(balance(), jc.ILQR(), starts, shared.policy)
    assert own.status.ok.all() and (own.num_steps == 0).all()
    one = jax.vmap(lambda x, policy: jc.solve(balance(), jc.ILQR(), x, us=policy).cost)
    np.testing.assert_allclose(one(starts, shared.policy), own.cost, rtol=1e-9)
    with pytest.raises(ValueError, match="the same B in each"):
        jc.solve_batch(balance(), jc.ILQR(), starts[:2], shared.policy)


def test_gradients_do_not_go_through_the_start(solution):
    start = X0 + np.array([0.1, -0.2])
    us = jc.simulate(balance(), solution.policy, start).us
    got, want = (
        jax.grad(lambda x, us=us: jc.solve(balance(), jc.ILQR(), x, us=us).cost)(start)
        for us in (solution.policy, us)
    )
    np.testing.assert_allclose(got, want, rtol=1e-12)


def test_a_policy_of_another_problem_or_that_diverges_is_no_start(solution):
    with pytest.raises(ValueError, match=r"AffinePolicy: its us has shape \(40, 1\)"):
        jc.solve(balance(T - 1), jc.ILQR(), X0, us=solution.policy)
    spoilt = eqx.tree_at(lambda p: p.K, solution.policy, solution.policy.K.at[3].set(jnp.nan))
    found = jc.solve(balance(), jc.ILQR(), X0 + 0.1, us=spoilt)
    assert not found.status.ok and found.status.is_(jc.Reason.NONFINITE_INPUT)


UP = np.array([0.0, np.pi, 0.0, 0.0])


def predictive(warm, seed):
    """Balance a cart-pole that is pushed at each of 30 steps, replanning for three iterations."""
    cost = jc.QuadraticCost(
        Q=[1.0, 10.0, 0.1, 0.1], R=0.01, Qf=[10.0, 100.0, 10.0, 10.0], target=UP
    )
    problem = jc.Problem(jc.plants.CartPole(), cost, num_steps=30, dt=0.05)
    x, total = UP, 0.0
    plan = jc.solve(problem, jc.ILQR(), x)
    for push in 0.1 * np.random.default_rng(seed).normal(size=(30, 2)):
        total += float(problem.dt * problem.running(x, plan.us[0], 0.0))
        x = problem.step(x, plan.us[0], 0.0) + np.array([0.0, 0.0, *push])
        policy = plan.policy.shifted(1)
        us = policy if warm else policy.us
        if not warm and not np.isfinite(us).all():
            return np.inf  # the plan before had diverged
        plan = jc.solve(problem, jc.ILQR(), x, us=us, max_steps=3)
    return total


@pytest.mark.parametrize("seed", range(3))
def test_predictive_control_of_a_cart_pole_is_better_warm_in_closed_loop_than_in_open_loop(seed):
    assert predictive(True, seed) < 0.3 * predictive(False, seed)
