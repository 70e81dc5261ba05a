"""A solution checked along its own states: an unstable plant is told from another problem."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxctrl as jc

RATE, DT, T, X0 = 2.0, 0.05, 420, np.array([0.5])


def linear(x, u, t, p):
    return p * x + u


def unstable(num_steps=T, rate=RATE, **weights):
    plant = jc.FunctionPlant(linear, nx=1, nu=1, params=rate)
    cost = jc.QuadraticCost(**({"Q": 1.0, "R": 0.5} | weights))
    return jc.Problem(plant, cost, num_steps=num_steps, dt=DT)


@pytest.fixture(scope="module")
def long():
    return jc.solve(unstable(), jc.ILQR(), X0)


def by_hand(xs, us):
    return 0.5 * DT * ((np.asarray(xs)[:-1] ** 2).sum() + 0.5 * (np.asarray(us) ** 2).sum())


def test_an_unstable_plant_is_named_as_the_reason(long):
    """Growth e^40: along its own states all is well, and the controls alone lead elsewhere."""
    assert long.status.ok and long.status.feedback_needed
    assert "run the policy" in long.status.message and "run the policy" in str(long)
    audit = jc.audit(unstable(), long)
    np.testing.assert_allclose(audit.cost, by_hand(long.xs, long.us), rtol=1e-12)
    np.testing.assert_allclose(audit.reported, audit.cost, rtol=1e-10)
    np.testing.assert_allclose(audit.policy_cost, audit.cost, rtol=1e-10)
    x, xs, us = X0 * (1 + 2.0**-52), [X0], np.asarray(long.us) * (1 + 2.0**-52)
    for u in us:
        x = x + DT * (RATE * x + u)
        xs.append(x)
    assert by_hand(xs, us) > 10 * audit.cost and audit.rollout_cost > 10 * audit.cost
    a = 1 + RATE * DT
    np.testing.assert_allclose(audit.growth, np.sqrt((a ** (2 * np.arange(T))).sum()), rtol=1e-9)
    assert 39 < np.log(audit.growth) < 42
    assert audit.sound and not audit.reproducible
    text = str(audit)
    assert text.startswith("Audit of a solution: sound")
    assert "rounding errors grow 5e+17 times; its policy does: run that" in text
    assert text.count("\n") == 8


def test_a_short_horizon_is_reproduced_and_gives_no_reason():
    short = unstable(num_steps=20)
    solution = jc.solve(short, jc.ILQR(), X0)
    assert not solution.status.feedback_needed and "policy" not in solution.status.message
    audit = jc.audit(short, solution)
    assert audit.sound and audit.reproducible
    np.testing.assert_allclose(audit.rollout_cost, audit.cost, rtol=1e-12)
    assert audit.defects.shape == (20,) and audit.defects.max() < 1e-15
    assert str(audit).count("\n") == 7


def test_another_cost_and_another_plant_are_told_apart(long):
    dearer = jc.audit(unstable(Q=2.0), long)
    assert not dearer.sound and not dearer.reproducible
    text = str(dearer)
    assert "NOT sound" in text and "does not cost what was reported" in text
    assert "does not lead to its next state" not in text

    moved = jc.audit(unstable(rate=2.5), long)
    assert not moved.sound
    want = np.abs(DT * 0.5 * np.asarray(long.xs)[:-1, 0]) / np.abs(long.xs).max()
    np.testing.assert_allclose(moved.defects, want, rtol=1e-9, atol=1e-15)
    assert "step 0 does not lead to its next state: another plant" in str(moved)
    spoilt = eqx.tree_at(lambda s: s.xs, long, long.xs.at[7].add(1e-6))
    assert "step 7 does not lead" in str(jc.audit(unstable(), spoilt))


def test_growth_of_several_states_does_not_depend_on_their_units():
    def made(unit):
        def dynamics(x, u, t):
            q, w = x[0], x[1] / unit
            return jnp.stack([w, unit * (3 * jnp.sin(q) + u[0])])

        plant = jc.FunctionPlant(dynamics, nx=2, nu=1)
        task = jc.Problem(plant, jc.QuadraticCost(R=1.0), num_steps=60, dt=0.05)
        xs = task.rollout(jnp.array([0.1, 0.2 * unit]), jnp.zeros((60, 1)))
        solution = jc.solve(task, jc.ILQR(), xs[0])
        return jc.audit(task, solution), xs

    audit, xs = made(1.0)
    np.testing.assert_allclose(made(1e4)[0].growth, audit.growth, rtol=1e-9)
    S, scale = np.zeros((2, 2)), np.abs(np.asarray(xs)).max(0)
    found = []
    for x in np.asarray(xs)[:-1]:
        A = np.eye(2) + 0.05 * np.array([[0, 1], [3 * np.cos(x[0]), 0]])
        A = A * scale / scale[:, None]
        S = A @ S @ A.T + np.eye(2)
        found.append(S.diagonal().max())
    np.testing.assert_allclose(audit.growth, np.sqrt(max(found)), rtol=1e-9)


def test_audits_go_through_vmap_and_float32(float32):
    short = unstable(num_steps=20)
    starts = np.array([[0.5], [1.0]], np.float32)
    solutions = jc.solve_batch(short, jc.ILQR(), starts)
    audits = jax.vmap(lambda s: jc.audit(short, s))(solutions)
    assert audits.sound.shape == (2,) and audits.sound.all() and audits.reproducible.all()
    assert not np.any(solutions.status.feedback_needed)
    both = jc.solve_batch(unstable(200), jc.ILQR(), starts).status
    assert both.message.splitlines()[-1].startswith("2 of 2: the plant is unstable")
    failed = jc.audit(unstable(520), jc.solve(unstable(520), jc.ILQR(), X0))
    assert not failed.sound and "its cost is not finite: a solve that failed" in str(failed)


def test_an_overflow_is_infinite_and_misfits_are_named(long):
    far = unstable(num_steps=T, rate=60.0)
    assert jc.audit(far, long).growth == jnp.inf
    with pytest.raises(ValueError, match=r"AffinePolicy: its us has shape \(420, 1\)"):
        jc.audit(unstable(num_steps=20), long)
    with pytest.raises(TypeError, match=r"problem, solution: .* got a Problem and a AffinePolicy"):
        jc.audit(unstable(), long.policy)


def reactor(num_steps):
    """The stirred-tank reactor of Luus (2000), whose optima cost 0.13309 and 0.24443."""

    def dynamics(x, u, t):
        reaction = (x[1] + 0.5) * jnp.exp(25 * x[0] / (x[0] + 2))
        return jnp.stack([reaction - (2 + u[0]) * (x[0] + 0.25), 0.5 - x[1] - reaction])

    cost = jc.FunctionCost(running=lambda x, u, t: x @ x + 0.1 * u @ u)
    plant = jc.FunctionPlant(dynamics, nx=2, nu=1)
    T = num_steps
    return jc.Problem(plant, cost, num_steps=T, dt=0.78 / T, integrator=jc.RK4())


def test_a_reactor_in_steps_too_long_lives_off_the_integrator():
    x0 = jnp.array([0.09, 0.09])
    fine, coarse = reactor(80), reactor(40)
    for start, best in ((0.0, 0.24443), (2.0, 0.13309)):
        solution = jc.solve(fine, jc.DDP(), x0, jnp.full((80, 1), start))
        assert solution.status.ok and solution.num_steps <= 30
        np.testing.assert_allclose(solution.cost, best, rtol=5e-3)
        assert "too long" not in str(jc.audit(fine, solution))
    found = jc.solve(coarse, jc.DDP(), x0, max_steps=60)
    assert found.cost < 0.1  # below the least cost that there is
    audit = jc.audit(coarse, found)
    worst = int(audit.integration.argmax())
    assert f"step {worst} is too long to be integrated" in str(audit)
    by_scipy = solve_ivp(
        lambda t, x: np.asarray(coarse.plant(jnp.asarray(x), found.us[worst], t)),
        (0, 0.78 / 40), np.asarray(found.xs[worst]), rtol=1e-8,
    ).y[:, -1]  # fmt: skip
    off = np.abs(by_scipy - np.asarray(found.xs[worst + 1])) / np.abs(found.xs).max(0)
    assert off.max() > 0.1


def test_a_spoilt_policy_other_bounds_and_round_off_of_costs_are_told_apart():
    short = unstable(num_steps=20)
    solution = jc.solve(short, jc.ILQR(), X0)
    spoilt = eqx.tree_at(lambda s: s.policy.us, solution, solution.policy.us + 0.1)
    audit = jc.audit(short, spoilt)
    assert audit.sound and audit.reproducible and not audit.controlled
    assert "its policy does not lead along its states" in str(audit)
    assert jc.audit(short, solution).controlled

    plant = jc.FunctionPlant(linear, nx=1, nu=1, params=RATE)
    tight = jc.Problem(plant, short.cost, num_steps=20, dt=DT, control_bounds=(-0.1, 0.1))
    audit = jc.audit(tight, solution)
    assert not audit.sound and "outside the problem's bounds" in str(audit)
    largest = float(jnp.abs(solution.us).max())
    np.testing.assert_allclose(audit.excess, (largest - 0.1) / largest, rtol=1e-12)

    # To the goal in one step: what is left of the cost is rounding, and no sign of instability.
    one = jc.FunctionPlant(lambda x, u, t: 0.7 * x + 0.3 * u, nx=1, nu=1, discrete=True)
    exact = jc.Problem(one, jc.QuadraticCost(Qf=1.0, target=[0.3]), num_steps=1)
    audit = jc.audit(exact, jc.solve(exact, jc.ILQR(), X0))
    assert audit.cost < 1e-30 and audit.reproducible and "unstable" not in str(audit)


def test_an_exact_step_is_not_too_long():
    arm, model = jc.plants.TorqueArm(), jc.models.MinimumJerk()
    task = jc.tasks.reach(arm, [0.0, 0.45], 0.5, num_steps=4)
    smooth = model.problem(task)
    solution = jc.solve(smooth, jc.ILQR(), model.start(task, np.array([0.6, 1.6, 0.0, 0.0])))
    audit = jc.audit(smooth, solution)
    assert audit.integration.max() == 0 and "too long" not in str(audit)
