"""The problem library against CasADi's version of it, and its optima against IPOPT's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("casadi")

import casadi_robots as robots
import nlp
from library_cases import LIBRARY, from_afar

import jaxctrl as jc
from jaxctrl.plants import Acrobot, Car, CartPole, PlanarQuadrotor

QUICK = ("double-integrator", "pendulum-2005")


@pytest.mark.parametrize(
    ("build", "oracle", "numbers"),
    [
        (CartPole, robots.cart_pole, dict(M=1.7, m=0.6, l=0.8, g=5.0)),
        (Acrobot, robots.acrobot, dict(
            m=(0.7, 1.9), l=(0.8, 1.3), centre=(0.3, 0.6), inertia=(0.2, 0.05), friction=(0.3, 0.1),
            g=3.7)),
        (PlanarQuadrotor, robots.planar_quadrotor, dict(m=1.4, l=0.5, inertia=0.09, g=1.6)),
    ],
)  # fmt: skip
def test_dynamics_are_lagranges(build, oracle, numbers):
    rng = np.random.default_rng(0)
    for given in ({}, numbers):
        plant, rate = build(**given), oracle(**given)[1]
        xs, us = rng.uniform(-4, 4, (50, plant.nx)), rng.uniform(-5, 5, (50, plant.nu))
        got = jax.jit(jax.vmap(lambda x, u, plant=plant: plant(x, u, 0.0)))(xs, us)
        want = np.array([rate(x, u).full().ravel() for x, u in zip(xs, us, strict=True)])
        np.testing.assert_allclose(got, want, rtol=1e-10, atol=1e-10 * np.abs(want).max())


def test_the_car_is_that_of_two_axles_at_a_distance():
    rng = np.random.default_rng(0)
    for d, dt in ((2.0, 0.03), (1.3, 0.1)):
        plant, oracle = Car(d=d), robots.car(d)
        for x, u in zip(
            rng.normal(size=(50, 4)) * [1, 1, 2, 8], rng.normal(size=(50, 2)), strict=True
        ):
            want = oracle.step(x, u, dt).full().ravel()
            np.testing.assert_allclose(plant(jnp.asarray(x), u, 0.0, dt), want, atol=1e-13)


@pytest.mark.parametrize("name", LIBRARY)
def test_problem_and_start_are_the_ones_stated(name):
    """Roll-outs and costs of random controls agree, and so do bounds and starting states."""
    benchmark, oracle = jc.problems.load(name), LIBRARY[name]()
    problem = benchmark.problem
    np.testing.assert_allclose(benchmark.x0, oracle.x0, rtol=1e-15)
    bounds = (-np.inf, np.inf) if problem.bounds is None else problem.bounds
    for got, want in zip(bounds, (oracle.lower, oracle.upper), strict=True):
        np.testing.assert_allclose(np.broadcast_to(got, benchmark.us.shape)[0], want, rtol=1e-15)
    noise = np.random.default_rng(0).normal(size=benchmark.us.shape)
    us = np.clip(np.asarray(benchmark.us) + 0.1 * noise, oracle.lower, oracle.upper)
    xs, cost = nlp.rollout(oracle, us)
    got = jax.jit(lambda us: problem.rollout(benchmark.x0, us))(us)
    np.testing.assert_allclose(got, xs, atol=1e-9 * np.abs(xs).max())
    np.testing.assert_allclose(problem.total_cost(got, us), cost, rtol=1e-9)


def cases():
    return [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in LIBRARY]


@pytest.mark.parametrize("name", cases())
def test_ipopt_finds_the_recorded_optimum_from_the_start(name):
    benchmark, oracle = jc.problems.load(name), LIBRARY[name]()
    near = jc.solve(benchmark.problem, jc.ILQR(), benchmark.x0, benchmark.us)
    found = from_afar(oracle, np.asarray(benchmark.us), np.asarray(near.us))
    assert found.status == "Solve_Succeeded"
    # The six muscles have several optima, and IPOPT too ends in one that is not the best.
    bar = {"muscle-arm": 2e-5, "muscle-arm-brown": 5e-4}.get(name, 1e-6)
    assert -1e-6 <= benchmark.excess(nlp.rollout(oracle, found.us)[1]) <= bar
