"""Derivatives through a solve, against re-solved finite differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import PROBLEMS

import jaxctrl as jc

TIGHT = jc.ILQR(gradient_tolerance=1e-7, cost_tolerance=1e-14)
CASES = ["pendulum", "pendulum, bounded", "torque arm, reach, bounded"]


def differences(value, leaf, h):
    """Return central differences (..., leaf.size) of value(leaf) with relative steps h."""
    columns = []
    for i in np.ndindex(leaf.shape):
        step = h * max(1.0, abs(float(leaf[i])))
        up, down = value(leaf.at[i].add(step)), value(leaf.at[i].add(-step))
        columns.append((up - down) / (2 * step))
    return jnp.stack(columns, axis=-1)


@pytest.mark.parametrize("name", CASES)
def test_controls_and_cost_differentiate_in_the_start_and_in_a_plant_parameter(name):
    problem, x0 = PROBLEMS[name]()
    reference = jc.solve(problem, TIGHT, x0)
    assert reference.status.ok
    where = (
        (lambda p: p.plant.m) if name.startswith("pendulum") else (lambda p: p.plant.skeleton.m2)
    )

    @jax.jit
    def solved(x0, mass):
        changed = eqx.tree_at(where, problem, mass)
        return jc.solve(changed, TIGHT, x0, reference.us)

    mass = where(problem)
    for argument, leaf in ((0, x0), (1, mass)):

        def at(leaf, argument=argument):
            return solved(*((leaf, mass) if argument == 0 else (x0, leaf)))

        d_cost, d_us = jax.jacrev(lambda leaf, at=at: (at(leaf).cost, at(leaf).us))(leaf)
        flat = d_us.reshape(*reference.us.shape, -1)
        # Too long a step changes the set of bounds that hold; too short a one shows how far from
        # the optimum the re-solves end.
        errors = []
        for h in (1e-2, 1e-3, 1e-4):
            wanted = differences(lambda leaf, at=at: at(leaf).us, leaf, h)
            errors.append(float(jnp.abs(flat - wanted).max() / jnp.abs(wanted).max()))
        assert min(errors) < 3e-4, errors
        wanted = differences(lambda leaf, at=at: at(leaf).cost, leaf, 1e-4)
        np.testing.assert_allclose(d_cost.ravel(), wanted, rtol=1e-6, atol=1e-7)


def test_bounds_that_bind_move_their_controls_and_the_others():
    problem, x0 = PROBLEMS["pendulum, bounded"]()

    def solve(upper):
        bounded = jc.Problem(
            problem.plant,
            problem.cost,
            num_steps=problem.num_steps,
            dt=problem.dt,
            control_bounds=(-3.0, upper),
        )
        return jc.solve(bounded, TIGHT, x0)

    upper = jnp.array(3.0)
    solution, slope = solve(upper), jax.jacfwd(lambda b: solve(b).us)(upper)
    held = solution.us == upper
    assert held.any()
    np.testing.assert_array_equal(slope[held], 1.0)
    wanted = (solve(upper + 1e-5).us - solve(upper - 1e-5).us) / 2e-5
    np.testing.assert_allclose(slope, wanted, rtol=1e-4, atol=1e-5)


def test_forward_and_reverse_mode_agree():
    problem, x0 = PROBLEMS["torque arm, reach, bounded"]()

    def us(x0):
        return jc.solve(problem, TIGHT, x0).us

    np.testing.assert_allclose(jax.jacfwd(us)(x0), jax.jacrev(us)(x0), rtol=1e-9, atol=1e-10)


def test_a_solve_that_did_not_converge_has_nan_derivatives_of_its_controls():
    problem, x0 = PROBLEMS["pendulum"]()
    slope = jax.jacfwd(lambda x0: jc.solve(problem, TIGHT, x0, max_steps=1).us)(x0)
    assert jnp.isnan(slope).all()
