"""Todorov's (2005) sensorimotor problem against his own recursion, exact moments and trials."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from observed_oracle import as_numpy, exact_cost, kalman_lqg, second_moments, trials

from jaxctrl.linear import AffineLaw, multiplicative_lqg, observed_moments
from jaxctrl.linear._multiplicative_lqg import signal_dependent


def reach(internal=None, dtype=float):
    """Return the reach of Todorov (2005): position, velocity, force, its filter, and the target.

    1 kg, two filters of 40 ms, 29 steps of 10 ms, 0.1 m; noise of half the control; `internal` is
    the standard deviation per step of the estimator's own noise in m, m/s, N and N.
    """
    dt, tau = 0.01, 0.04
    A, B = np.eye(5), np.zeros((5, 1))
    A[0, 1] = A[1, 2] = dt
    A[2, 2] = A[3, 3] = 1 - dt / tau
    A[2, 3] = B[3, 0] = dt / tau
    goal = np.array([[1, 0, 0, 0, -1], [0, 0.2, 0, 0, 0], [0, 0, 0.02, 0, 0]])
    Q = np.zeros((30, 5, 5))
    Q[-1] = goal.T @ goal
    problem = {
        "A": A, "B": B, "C": np.array([[[0.5]]]), "C0": None,
        "H": np.eye(5)[:3], "D": None, "D0": np.diag([0.01, 0.1, 0.5]),
        "E0": None if internal is None else internal * np.eye(5)[:, :4],
        "Q": Q, "R": np.array([[1e-5 / 30]]),
        "X1": np.array([0, 0, 0, 0, 0.1]), "S1": np.zeros((5, 5)),
    }  # fmt: skip
    return {name: None if a is None else a.astype(dtype) for name, a in problem.items()}


def sensed(seed=0):
    """Return a random problem with every kind of noise."""
    rng = np.random.default_rng(seed)
    return {
        "A": np.eye(4) + 0.2 * rng.normal(size=(4, 4)), "B": rng.normal(size=(4, 2)),
        "C": 0.3 * rng.normal(size=(2, 2, 2)), "C0": 0.1 * rng.normal(size=(4, 3)),
        "H": rng.normal(size=(3, 4)), "D": 0.2 * rng.normal(size=(2, 3, 4)),
        "D0": 0.2 * np.eye(3), "E0": None, "Q": np.tile(np.eye(4), (11, 1, 1)),
        "R": np.eye(2), "X1": rng.normal(size=4), "S1": 0.1 * np.eye(4),
    }  # fmt: skip


def check_exactly(problem, found, rtol=1e-10, count=100_000):
    """Compare a cost with exact moments and with trials; return how many errors it is off."""
    model, sensing, mean, cov = as_numpy_problem(problem)
    law = AffineLaw(np.asarray(found.k), -np.asarray(found.L))
    gains = np.asarray(found.K)
    exact, _ = exact_cost(model, sensing, law, gains, second_moments(mean, cov))
    np.testing.assert_allclose(found.cost, exact, rtol=rtol)
    moments = observed_moments(model, sensing, law, gains, cov, mean)
    np.testing.assert_allclose(moments.cost, exact, rtol=rtol)
    costs, last = trials(model, sensing, law, gains, mean, cov, count, 0)
    z = (costs.mean() - exact) / (costs.std() / np.sqrt(count))
    sd = np.sqrt(np.diagonal(moments.cov_x[-1]))
    np.testing.assert_allclose(last.std(axis=1), sd, rtol=0.02, atol=1e-12)
    return z


def as_numpy_problem(problem):
    model, sensing, mean, cov = signal_dependent(**problem)
    return as_numpy(model), as_numpy(sensing), np.asarray(mean), np.asarray(cov)


@pytest.mark.parametrize("which", ["reach", "every noise", "internal"])
def test_the_published_form_is_todorov_s(which):
    problem = {"reach": reach(), "every noise": sensed(), "internal": reach(0.005)}[which]
    found = multiplicative_lqg(**problem, form="published")
    L, K, costs = kalman_lqg(**problem)
    assert found.converged and (found.k == 0).all()
    np.testing.assert_allclose(found.cost, costs[-1], rtol=1e-9)
    np.testing.assert_allclose(found.L, L, rtol=1e-5, atol=1e-6 * np.abs(L).max())
    np.testing.assert_allclose(found.K, K, rtol=1e-5, atol=1e-6 * np.abs(K).max())
    z = check_exactly(problem, found)
    print(f"{which}: {found.cost:.8f} after {found.num_steps} sweeps, trials z {z:+.2f}")
    assert abs(z) < 3
    if which != "internal":
        history = np.asarray(found.history).ravel()
        assert np.nanmax(np.diff(history)) < 1e-12 * history[0]


@pytest.mark.parametrize("internal", [0.001, 0.005, 0.02])
def test_with_internal_noise_the_corrected_form_costs_less(internal):
    """By as much as the estimate can be scaled up beside its noise (Damiani et al. 2024)."""
    problem = reach(internal)
    published = multiplicative_lqg(**problem, form="published")
    found = multiplicative_lqg(**problem, max_steps=100)
    history = np.asarray(found.history)[: int(found.num_steps)].ravel()
    assert np.max(np.diff(history)) <= 1e-9 * history[0]
    z = check_exactly(problem, found, rtol=1e-7)  # gains of 1e6
    less = 1 - found.cost / published.cost
    print(f"{internal}: {published.cost:.6f}, corrected {found.cost:.6f}, {less:.2%}; z {z:+.2f}")
    assert abs(z) < 3
    least = {0.001: 0.005, 0.005: 0.05, 0.02: 0.25}[internal]
    assert least < less < 1 - multiplicative_lqg(**reach()).cost / published.cost


def test_without_internal_noise_both_forms_are_one():
    forms = [multiplicative_lqg(**sensed(), form=form) for form in ("corrected", "published")]
    np.testing.assert_array_equal(*(found.L for found in forms))


def test_matrices_may_change_with_time():
    problem = sensed()
    constant = multiplicative_lqg(**problem)
    steps = {name: np.tile(problem[name], (10, 1, 1)) for name in "ABHR"}
    np.testing.assert_allclose(multiplicative_lqg(**problem | steps).L, constant.L, rtol=1e-12)


def test_float32_reaches_the_cost_of_the_reach():
    wanted = multiplicative_lqg(**reach()).cost
    with jax.enable_x64(False):
        found = multiplicative_lqg(**reach(dtype=np.float32))
        assert found.cost.dtype == jnp.float32
    np.testing.assert_allclose(found.cost, wanted, rtol=1e-3)


def test_the_cost_s_derivative_by_the_sensor_s_noise_is_that_of_differences():
    problem = sensed()

    def cost(D0):
        return multiplicative_lqg(**problem | {"D0": D0}).cost

    d = np.eye(3)[:, :1] * np.eye(3)[:1]
    slope = np.sum(jax.jit(jax.grad(cost))(problem["D0"]) * d)
    difference = (cost(problem["D0"] + 1e-5 * d) - cost(problem["D0"] - 1e-5 * d)) / 2e-5
    np.testing.assert_allclose(slope, difference, rtol=1e-6)


WRONG = {
    "A": (np.eye(3), r"A: got shape \(3, 3\), wanted \(4, 4\)"),
    "B": (np.ones((3, 2)), r"B: got shape \(3, 2\), wanted \(4, any\)"),
    "C": (np.ones((2, 2)), r"C: got shape \(2, 2\), wanted \(any, 2, 2\)"),
    "C0": (np.ones((3, 4)), r"C0: got shape \(3, 4\), wanted \(4, any\)"),
    "D": (np.ones((3, 4, 2)), r"D: got shape \(3, 4, 2\), wanted \(any, 3, 4\)"),
    "Q": (np.ones((4, 4)), r"Q: got shape \(4, 4\), wanted \(any, any, any\)"),
    "R": (np.array([[1.0, np.nan], [0, 1]]), r"R: not finite at index \(0, 1\)"),
    "S1": (-np.eye(4), "S1: a covariance has no negative eigenvalue, got -1"),
    "X1": (np.ones((4, 1)), r"X1: got shape \(4, 1\), wanted \(4,\)"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_does_not_fit_is_named(name):
    value, message = WRONG[name]
    with pytest.raises(ValueError, match=message):
        multiplicative_lqg(**sensed() | {name: value})
    with pytest.raises(TypeError, match=f"{name}: a real number or an array is wanted"):
        multiplicative_lqg(**sensed() | {name: "one"})
