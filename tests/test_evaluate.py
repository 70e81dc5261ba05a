"""Monte Carlo of controllers: against closed forms, single trials, and its own bookkeeping."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc

KEY = jax.random.key(3)


@pytest.fixture(scope="module")
def task():
    arm = jc.plants.TorqueArm()
    x0 = arm.at_rest(shoulder=0.785, elbow=1.571)
    target = np.asarray(arm.hand(x0)) + np.array([-0.08, 0.08])
    problem = jc.tasks.reach(arm, target, 0.3, num_steps=20, motor_noise=0.1)
    return problem, x0, jc.solve(problem, jc.ILQG(), x0)


def test_trials_are_those_of_simulate_with_folded_keys(task):
    problem, x0, solution = task
    found = jc.evaluate(problem, solution.policy, x0, key=KEY, trials=70)  # more than one chunk
    for i in (0, 5, 69):
        trial = jc.simulate(problem, solution.policy, x0, key=jax.random.fold_in(KEY, i))
        np.testing.assert_allclose(found.costs[i], trial.cost, rtol=1e-12)
        np.testing.assert_allclose(found.ends[i], trial.xs[-1], rtol=1e-12)
        np.testing.assert_allclose(found.hands[i], problem.plant.hand(trial.xs[-1]), rtol=1e-12)
    few = jc.evaluate(problem, solution.policy, x0, key=KEY, trials=10)
    np.testing.assert_allclose(few.costs, found.costs[:10], rtol=1e-12)
    np.testing.assert_allclose(found.cost_error, np.std(found.costs, ddof=1) / 70**0.5)
    np.testing.assert_allclose(found.hand_cov, np.cov(np.asarray(found.hands).T), rtol=1e-10)
    np.testing.assert_allclose(found.end_cov, np.cov(np.asarray(found.ends).T), rtol=1e-10)
    assert found.collided is None
    with pytest.raises(ValueError, match="no obstacle"):
        _ = found.collisions


def test_controllers_meet_the_same_noise(task):
    problem, x0, solution = task
    with pytest.warns(UserWarning, match="ignores"):
        deterministic = jc.solve(problem, jc.ILQR(), x0)
    found = jc.evaluate(
        problem,
        {"ILQG": solution.policy, "ILQR": deterministic.policy, "open": jc.OpenLoop(solution.us)},
        x0, key=KEY, trials=400,
    )  # fmt: skip
    alone = jc.evaluate(problem, solution.policy, x0, key=KEY, trials=400)
    np.testing.assert_array_equal(found["ILQG"].costs, alone.costs)
    for worse, better in (("open", "ILQR"), ("ILQR", "ILQG")):
        difference, error = found[worse].difference(found[better])
        assert difference > 3 * error
        apart = float(jnp.hypot(found[worse].cost_error, found[better].cost_error))
        assert error < apart, "trials are not paired"
    assert abs(found["ILQG"].cost - solution.expected_cost) < 0.05 * solution.expected_cost
    assert found["ILQG"].hits(0.01) > found["open"].hits(0.01)
    assert "ILQG" not in str(found["ILQG"]) and "cost" in str(found["ILQG"])


def test_collisions_are_seen_between_the_samples_too(task):
    problem, x0, solution = task
    hands = np.asarray(jax.vmap(problem.plant.hand)(solution.xs))
    k = int(np.argmax(np.linalg.norm(np.diff(hands, axis=0), axis=1)))
    middle, step = (hands[k] + hands[k + 1]) / 2, np.linalg.norm(hands[k + 1] - hands[k])
    for radius, expected in ((0.3 * step, 1.0), (1e-9, 0.0)):
        across = np.array([hands[k, 1] - hands[k + 1, 1], hands[k + 1, 0] - hands[k, 0]]) / step
        centre = middle + 0.2 * step * across
        obstacle = jc.tasks.Obstacle(centre, radius)
        silent = eqx.tree_at(lambda p: p.noise.intensity, problem, jnp.array(0.0)) + obstacle
        found = jc.evaluate(silent, solution.policy, x0, key=KEY, trials=2)
        assert found.collisions == expected
        np.testing.assert_allclose(found.costs_without_obstacles, solution.nominal_cost)
        assert (found.costs > found.costs_without_obstacles).all()


def test_another_plant_and_noise_may_act(task):
    problem, x0, solution = task
    field = jc.plants.InField(problem.plant, jc.plants.Curl(2.0))
    found = jc.evaluate(
        problem, solution.policy, x0, key=KEY, trials=3, plant=field, noise=jc.AdditiveNoise(0.01)
    )
    trial = jc.simulate(
        problem, solution.policy, x0, key=jax.random.fold_in(KEY, 2), plant=field,
        noise=jc.AdditiveNoise(0.01),
    )  # fmt: skip
    np.testing.assert_allclose(found.costs[2], trial.cost, rtol=1e-12)


def test_bad_arguments_are_named(task):
    problem, x0, solution = task
    policy = solution.policy
    with pytest.raises(ValueError, match="trials: at least 2"):
        jc.evaluate(problem, policy, x0, key=KEY, trials=1)
    with pytest.raises(TypeError, match="key"):
        jc.evaluate(problem, policy, x0, key=3)
    with pytest.raises(ValueError, match="controllers: at least one"):
        jc.evaluate(problem, {}, x0, key=KEY)
    with pytest.raises(TypeError, match="controller"):
        jc.evaluate(problem, solution, x0, key=KEY)
    with pytest.raises(ValueError, match="x0: got shape"):
        jc.evaluate(problem, policy, x0[:3], key=KEY)


def test_a_batch_of_evaluations_has_a_mean_for_each():
    plant = jc.FunctionPlant(lambda x, u, t: jnp.stack([x[1], u[0]]), nx=2, nu=1)
    problem = jc.Problem(
        plant, jc.QuadraticCost(R=0.1, Qf=1.0), num_steps=5, dt=0.1, noise=jc.AdditiveNoise(0.1)
    )
    controller, x0 = jc.OpenLoop(jnp.ones((5, 1))), jnp.ones(2)

    def run(key):
        return jc.evaluate(problem, controller, x0, key=key, trials=20)

    keys = jax.random.split(jax.random.key(0), 3)
    many, one = jax.vmap(run)(keys), run(keys[1])
    for name in ("cost", "cost_error", "end_mean", "end_cov"):
        np.testing.assert_allclose(getattr(many, name)[1], getattr(one, name), rtol=1e-12)
    np.testing.assert_allclose(one.end_cov, np.cov(one.ends, rowvar=False), rtol=1e-12)
    with pytest.raises(ValueError, match="another key"):
        one.difference(run(keys[0]))
    with pytest.raises(ValueError, match="trials, wanted"):
        one.difference(jc.evaluate(problem, controller, x0, key=keys[1], trials=10))
    with pytest.raises(TypeError, match="an Evaluation is wanted"):
        one.difference(controller)
