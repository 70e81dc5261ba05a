"""Controllers with memory and perturbations: against loops in NumPy, and misfits that are named."""

import itertools
import re
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc

T, DT = 30, 0.05
A = np.array([[0.0, 1.0], [-2.0, -0.3]])
B = np.array([0.0, 1.5])
X0 = np.array([0.4, -0.2])


def linear(x, u, t, p):
    return p @ x + jnp.asarray(B) * u[0] + jnp.stack([jnp.zeros_like(x[0]), jnp.sin(t)])


def problem(num_steps=T, dt=DT, **arguments):
    plant = jc.FunctionPlant(linear, nx=2, nu=1, params=A)
    cost = jc.QuadraticCost(Q=1.0, R=0.1, Qf=2.0)
    return jc.Problem(plant, cost, num_steps=num_steps, dt=dt, **arguments)


class PI(jc.AbstractController):
    goal: jax.Array
    P: jax.Array
    I: jax.Array

    def init(self, problem, belief, key):
        return jnp.zeros_like(belief), problem.dt

    def step(self, memory, y, i, t, key):
        total, dt = memory
        total = total + dt * (self.goal - y)
        return (total, dt), self.P @ (self.goal - y) + self.I @ total


class Delayed(jc.AbstractController):
    """Feedback of what was sensed three steps ago, of the belief before that, and of time."""

    gain: jax.Array

    def init(self, problem, belief, key):
        return jnp.broadcast_to(belief, (3, belief.size))

    def step(self, memory, y, i, t, key):
        u = self.gain @ memory[0] + jnp.cos(t) * (i % 3)
        return jnp.concatenate([memory[1:], y[None]]), u


class Noisy(jc.AbstractController):
    """Draws its start and each of its controls, and remembers their sum."""

    def init(self, problem, belief, key):
        return jax.random.normal(key, (1,))

    def step(self, memory, y, i, t, key):
        memory = memory + jax.random.normal(key, (1,))
        return memory, memory


PI_GAINS = np.array([1.0, 0.5]), np.array([[3.0, 1.0]]), np.array([[2.0, 0.4]])


def rates(x, u, t):
    return A @ x + B * u[0] + np.array([0.0, np.sin(t)])


def run_pi(x, sensed=None, states=None):
    goal, P, I = PI_GAINS
    total, xs, us, ys = np.zeros(2), [x], [], []
    for k in range(T):
        y = x if sensed is None else x + sensed[k]
        total = total + DT * (goal - y)
        u = P @ (goal - y) + I @ total
        x = x + DT * rates(x, u, k * DT) + (0 if states is None else states[k])
        xs, us, ys = [*xs, x], [*us, u], [*ys, y]
    return np.array(xs), np.array(us), np.array(ys)


def run_delayed(x, belief):
    gain, past, xs, us = np.array([[-2.0, -1.0]]), [belief] * 3, [x], []
    for k in range(T):
        u = gain @ past[0] + np.cos(k * DT) * (k % 3)
        past = [*past[1:], x]
        x = x + DT * rates(x, u, k * DT)
        xs, us = [*xs, x], [*us, u]
    return np.array(xs), np.array(us)


def test_a_controller_with_an_integral_is_a_loop_in_numpy():
    got = jc.simulate(problem(), PI(*map(jnp.asarray, PI_GAINS)), X0)
    xs, us, ys = run_pi(X0)
    np.testing.assert_allclose(got.xs, xs, rtol=1e-12)
    np.testing.assert_allclose(got.us, us, rtol=1e-12)
    np.testing.assert_allclose(got.ys, ys, rtol=1e-12)
    np.testing.assert_array_equal(got.ys, got.xs[:-1])
    running = 0.5 * DT * ((xs[:-1] ** 2).sum(1) + 0.1 * us[:, 0] ** 2)
    np.testing.assert_allclose(got.costs, [*running, (xs[-1] ** 2).sum()], rtol=1e-12)


def test_a_controller_starts_from_its_belief_and_is_told_step_and_time():
    controller = Delayed(jnp.array([[-2.0, -1.0]]))
    belief = np.array([-1.0, 2.0])
    for given in (None, belief):
        got = jc.simulate(problem(), controller, X0, belief=given)
        xs, us = run_delayed(X0, X0 if given is None else belief)
        np.testing.assert_allclose(got.xs, xs, rtol=1e-12)
        np.testing.assert_allclose(got.us, us, rtol=1e-12)


def test_a_controller_draws_from_keys_of_its_own():
    key = jax.random.key(4)
    trial = jc.simulate(problem(), Noisy(), X0, key=key)
    assert len(np.unique(np.diff(trial.us[:, 0], prepend=0))) == T  # no draw twice
    # What the plant draws is independent of it: the same controls, whatever the noise.
    noisy = jc.simulate(problem(noise=jc.AdditiveNoise(0.3)), Noisy(), X0, key=key)
    np.testing.assert_array_equal(noisy.us, trial.us)
    with jax.debug_key_reuse(True):
        jc.simulate(problem(noise=jc.AdditiveNoise(0.3)), Noisy(), X0, key=jax.random.key(4))


def test_vmap_over_starts_is_a_loop_with_memory():
    controller = PI(*map(jnp.asarray, PI_GAINS))
    starts = np.array([[0.1, 0.2], [-0.5, 0.3], [2.0, 0.0]])
    xs = jax.vmap(lambda x0: jc.simulate(problem(), controller, x0).xs)(starts)
    np.testing.assert_allclose(xs, [run_pi(x0)[0] for x0 in starts], rtol=1e-12)


TRACED = itertools.count()


class Counted(jc.AbstractController):
    gain: jax.Array

    def init(self, problem, belief, key):
        return None

    def step(self, memory, y, i, t, key):
        next(TRACED)
        return memory, self.gain * y[:1]


def test_changing_a_number_does_not_compile_again():
    def run(seed):
        scale = jnp.asarray(float(seed))
        return jc.simulate(
            problem(dt=0.01 * (1 + seed)), Counted(scale), X0 * scale, belief=X0 + scale,
            key=jax.random.key(seed), noise=jc.AdditiveNoise(scale),
            pulses=jc.Pulses(states=np.full((T, 2), seed)),
        )  # fmt: skip

    run(1)
    first = next(TRACED)
    assert first > 0 and not np.array_equal(run(2).xs, run(3).xs) and next(TRACED) == first + 1


def test_gradients_go_through_the_memory():
    def cost(I):
        return jc.simulate(problem(), PI(*map(jnp.asarray, PI_GAINS[:2]), I), X0).cost

    I, h = jnp.array([[2.0, 0.4]]), 1e-6
    want = [(cost(I + d) - cost(I - d)) / (2 * h) for d in h * np.eye(2)[:, None]]
    np.testing.assert_allclose(jax.grad(cost)(I)[0], want, rtol=1e-6)


def test_the_documented_controller_is_this_one():
    text = (Path(__file__).parents[1] / "docs" / "design.md").read_text()
    (program,) = re.findall(r"```python\n(class PI.*?)```", text, re.DOTALL)
    names = {"jc": jc, "jnp": jnp, "jax": jax}
    exec(program, names)
    got = jc.simulate(problem(), names["PI"](*map(jnp.asarray, PI_GAINS)), X0)
    np.testing.assert_allclose(got.xs, run_pi(X0)[0], rtol=1e-12)
    inside = program.replace("\n", "\n        ").strip().replace("        \n", "\n")
    assert inside in jc.AbstractController.__doc__


def test_the_documented_jump_of_a_target_moves_the_sensed_hand_the_other_way():
    arm, T, k, d = jc.plants.TorqueArm(), 8, 3, jnp.array([2e-3, -1e-3])
    x = arm.at_rest(0.7, 1.4)
    q = x[:2]
    lines = [line for line in jc.Pulses.__doc__.split("\n") if line.startswith("        ")]
    names = dict(jax=jax, jnp=jnp, arm=arm, q=q, T=T, k=k, d=d)
    exec("\n".join(line.strip() for line in lines if re.match(r" +(J|sensed) = ", line)), names)
    shifts = jax.vmap(lambda shift: arm.hand(x + shift) - arm.hand(x))(names["sensed"])
    np.testing.assert_allclose(shifts[:k], 0.0, atol=1e-15)
    np.testing.assert_allclose(shifts[k:], jnp.tile(-d, (T - k, 1)), atol=5e-5)
    jc.Pulses(sensed=names["sensed"]).check(arm, T)


def test_shifts_of_the_state_and_of_what_is_sensed_are_a_loop_in_numpy():
    rng = np.random.default_rng(0)
    states, sensed = rng.normal(size=(2, T, 2))
    got = jc.simulate(
        problem(), PI(*map(jnp.asarray, PI_GAINS)), X0,
        pulses=jc.Pulses(states=states, sensed=sensed),
    )  # fmt: skip
    xs, us, ys = run_pi(X0, sensed, states)
    np.testing.assert_allclose(got.xs, xs, rtol=1e-12)
    np.testing.assert_allclose(got.us, us, rtol=1e-12)
    np.testing.assert_allclose(got.ys, ys, rtol=1e-12)


def test_a_target_jump_is_a_cursor_jump_the_other_way():
    """A regulator to a moved goal does what one to the first goal does that sees the hand moved."""
    goal, P, I = map(jnp.asarray, PI_GAINS)
    jump = np.array([0.3, 0.0])
    moved = jc.simulate(problem(), PI(goal + jump, P, I), X0)
    pulses = jc.Pulses(sensed=np.tile(-jump, (T, 1)))
    seen = jc.simulate(problem(), PI(goal, P, I), X0, pulses=pulses)
    np.testing.assert_allclose(seen.xs, moved.xs, rtol=1e-12)


@pytest.fixture(scope="module")
def reach():
    arm = jc.plants.TorqueArm()
    x0 = arm.at_rest(0.6, 1.4)
    task = jc.tasks.reach(
        arm, target=arm.hand(x0) + jnp.array([0.05, 0.1]), duration=0.4, num_steps=40
    )
    return task, x0, jc.OpenLoop(0.3 * jnp.sin(jnp.arange(2 * task.num_steps)).reshape(-1, 2))


@pytest.mark.parametrize("integrator", [jc.Euler(), jc.RK4()], ids=["euler", "rk4"])
def test_a_constant_force_is_a_constant_field(reach, integrator):
    task, x0, control = reach
    task = eqx.tree_at(lambda p: p.integrator, task, integrator)
    F = np.array([1.5, -2.0])
    field = jc.plants.InField(task.plant, jc.plants.ConstantForce(F))
    want = jc.simulate(task, control, x0, plant=field)
    got = jc.simulate(task, control, x0, pulses=jc.Pulses(forces=np.tile(F, (task.num_steps, 1))))
    np.testing.assert_allclose(got.xs, want.xs, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(got.costs, want.costs, rtol=1e-12)
    assert np.abs(got.xs - jc.simulate(task, control, x0).xs).max() > 0.1


def test_a_force_pulse_is_a_loop_in_numpy(reach):
    """From energies and geometry of the hand alone: M and J by differences, no field involved."""
    task, x0, control = reach
    forces = np.zeros((task.num_steps, 2))
    forces[10:15] = [3.0, 1.0]
    got = jc.simulate(task, control, x0, pulses=jc.Pulses(forces=forces))
    arm, dt, h = task.plant, float(task.dt), 1e-6
    x = np.asarray(x0)
    for k in range(task.num_steps):
        np.testing.assert_allclose(got.xs[k], x, rtol=1e-7, atol=1e-9)
        J = np.stack([
            (arm.hand_of_joints(x[:2] + d) - arm.hand_of_joints(x[:2] - d)) / (2 * h)
            for d in h * np.eye(2)
        ], axis=1)  # fmt: skip
        push = np.linalg.solve(np.asarray(arm.mass_matrix(x[:2])), J.T @ forces[k])
        x = x + dt * (np.asarray(arm(x, control.us[k], 0.0)) + np.array([0, 0, *push]))


@pytest.mark.parametrize(
    "plant", [jc.plants.RateControlled(jc.plants.TorqueArm()), jc.plants.MuscleArm()]
)
def test_forces_push_an_arm_of_muscles_and_one_with_torques_as_states(plant):
    """To one step the force adds M^-1 J'F dt, to the joints' velocities alone."""
    F, dt, q = np.array([2.0, 1.0]), 1e-3, np.array([0.6, 1.4])
    x = jnp.zeros(plant.nx).at[:2].set(q)
    J = np.asarray(jax.jacobian(plant.hand_of_joints)(q))
    still = jc.Problem(plant, jc.QuadraticCost(), num_steps=1, dt=dt)
    control = jc.OpenLoop(jnp.zeros((1, plant.nu)))
    free = jc.simulate(still, control, x).xs[1]
    got = jc.simulate(still, control, x, pulses=jc.Pulses(forces=F[None])).xs[1] - free
    want = np.linalg.solve(np.asarray(plant.mass_matrix(q)), J.T @ F) * dt
    np.testing.assert_allclose(got[2:4], want, rtol=1e-9)
    np.testing.assert_array_equal(np.delete(got, [2, 3]), 0.0)


def test_pulses_have_gradients_and_go_through_vmap(reach):
    task, x0, control = reach

    def end(height):
        forces = jnp.zeros((task.num_steps, 2)).at[5:10, 1].set(height)
        return task.plant.hand(jc.simulate(task, control, x0, pulses=jc.Pulses(forces)).xs[-1])[1]

    slope, h = jax.grad(end)(2.0), 1e-5
    np.testing.assert_allclose(slope, (end(2 + h) - end(2 - h)) / (2 * h), rtol=1e-7)
    ends = jax.vmap(end)(jnp.array([0.0, 2.0]))
    np.testing.assert_allclose(ends, [end(0.0), end(2.0)], rtol=1e-12)


def test_pulses_that_do_not_fit_are_named(reach):
    task, x0, control = reach
    n = task.num_steps
    for pulses, match in (
        (jc.Pulses(forces=np.zeros((n, 3))), rf"pulses.forces: got shape \({n}, 3\), wanted"),
        (jc.Pulses(forces=np.zeros((n - 1, 2))), "pulses.forces: got shape"),
        (jc.Pulses(states=np.zeros((n + 1, 4))), "pulses.states: got shape"),
        (jc.Pulses(sensed=np.full((n, 4), np.nan)), "pulses.sensed: not finite at index"),
    ):
        with pytest.raises(ValueError, match=match):
            jc.simulate(task, control, x0, pulses=pulses)
    with pytest.raises(ValueError, match=r"pulses.forces: .*joints.* got FunctionPlant"):
        jc.simulate(
            problem(), jc.OpenLoop(jnp.zeros((T, 1))), X0, pulses=jc.Pulses(np.zeros((T, 2)))
        )
    with pytest.raises(TypeError, match=r"pulses: jc.Pulses are wanted"):
        jc.simulate(task, control, x0, pulses=np.zeros((n, 2)))


@pytest.fixture(scope="module")
def solution():
    return jc.solve(problem(), jc.ILQR(), X0)


def grown(policy, **shapes):
    return jc.AffinePolicy(**{
        name: jnp.zeros(shapes.get(name, getattr(policy, name).shape))
        for name in ("xs", "us", "k", "K")
    })  # fmt: skip


def test_a_policy_of_another_problem_is_refused(solution):
    policy = solution.policy
    for other in (problem(num_steps=T + 1), problem(num_steps=T - 1)):
        for controller in (policy, jc.OpenLoop(solution.us)):
            with pytest.raises(ValueError, match=rf"its us has shape \({T}, 1\).*wants"):
                jc.simulate(other, controller, X0)
    with pytest.raises(ValueError, match=r"AffinePolicy: made for steps of 0.05 s, .* take 0.025"):
        jc.simulate(problem(dt=0.025), policy, X0)
    with pytest.raises(ValueError, match=r"OpenLoop: made for steps of 0.05 s"):
        jc.simulate(problem(dt=0.025), jc.OpenLoop(solution.us, dt=DT), X0)
    jc.simulate(problem(dt=0.025), jc.OpenLoop(solution.us), X0)  # for any step
    for wrong, match in (
        (grown(policy, us=(T, 2)), r"its us has shape \(30, 2\)"),
        (grown(policy, xs=(T, 2)), r"its xs has shape \(30, 2\).*wants \(31, 2\)"),
        (grown(policy, K=(T, 1, 3)), r"its K has shape"),
        (eqx.tree_at(lambda p: p.bounds, policy, (-jnp.ones(1), jnp.ones(1)),
                     is_leaf=lambda b: b is None), "its lower bound has shape"),
        (jc.OpenLoop(jnp.zeros((4, T, 1))), "a batch goes through jax.vmap"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=match):
            jc.simulate(problem(), wrong, X0)
    with pytest.raises(ValueError, match="bounds: the lower bound has shape"):
        jc.OpenLoop(jnp.zeros((T, 1)), (-np.ones(T), np.ones(T)))


def test_a_step_that_is_traced_gives_nan_in_the_lanes_where_it_is_another(solution):
    def cost(dt):
        other = eqx.tree_at(lambda p: p.dt, problem(), dt)
        return jc.simulate(other, solution.policy, X0).cost

    same, other = jax.vmap(cost)(jnp.array([DT, 0.04]))
    np.testing.assert_allclose(same, solution.cost, rtol=1e-12)
    assert np.isnan(other)
    # Rounded to float32 the step is the same.
    assert np.isfinite(jax.jit(cost)(jnp.float32(DT).astype(float)))
    # Beyond the last step there is no control, where an index would be clamped.
    fits = solution.policy.init(problem(), X0, None)
    for i, known in ((0, True), (T - 1, True), (T, False), (-1, False)):
        u = jax.jit(lambda i: solution.policy.step(fits, X0, i, 0.0, None)[1])(i)
        assert np.isfinite(u).all() == known


class Returns(jc.AbstractController):
    """Whatever it is told to start with and to return."""

    start: object = eqx.field(static=True, default=())
    out: object = eqx.field(static=True, default=None)

    def init(self, problem, belief, key):
        if self.start == "raise":
            raise KeyError("my own")
        return jnp.zeros(self.start)

    def step(self, memory, y, i, t, key):
        return self.out(memory, y)


@pytest.mark.parametrize(
    ("controller", "error", "match"),
    [
        (Returns((), lambda m, y: (m, jnp.zeros(2))), ValueError, r"a control \(2,\), wanted"),
        (Returns((), lambda m, y: (m, y[0])), ValueError, r"a control \(\), wanted shape \(1,\)"),
        (Returns((), lambda m, y: (m, [y[0]])), ValueError, "returned a control .*wanted shape"),
        (Returns((), lambda m, y: y[:1]), TypeError, r"a pair \(memory, control\) is wanted"),
        (Returns((), lambda m, y: (m, jnp.zeros(1, jnp.float32))), TypeError, "control float32"),
        (Returns((), lambda m, y: (y, y[:1])), TypeError, r"memory float64\[2\], init one float64"),
        (Returns((), lambda m, y: ((m, m), y[:1])), TypeError, "keep its structure"),
    ],
)  # fmt: skip
def test_what_a_controller_returns_is_checked(controller, error, match):
    with pytest.raises(error, match=match):
        jc.simulate(problem(), controller, X0)


def test_a_controllers_own_exceptions_pass_with_a_note():
    with pytest.raises(KeyError, match="my own") as caught:
        jc.simulate(problem(), Returns("raise"), X0)
    assert "Returns.init" in caught.value.__notes__[0]
    with pytest.raises(jax.errors.TracerBoolConversionError) as caught:
        jc.simulate(problem(), Returns((), lambda m, y: (m, y[:1] if y[0] > 0 else -y[:1])), X0)
    assert "jnp.where" in caught.value.__notes__[0]


def test_a_noise_of_another_length_or_not_finite_is_refused():
    control, key = jc.OpenLoop(jnp.ones((T, 1))), jax.random.key(0)
    for kind in (jc.SignalDependentNoise, jc.AdditiveNoise):
        with pytest.raises(ValueError, match=r"intensity: shape \(3,\), wanted \(\) or \(1,\)"):
            jc.simulate(problem(), control, X0, key=key, noise=kind([0.1, 0.2, 0.3]))
        with pytest.raises(ValueError, match="noise: intensity is not finite"):
            jc.simulate(problem(noise=kind(np.nan)), control, X0, key=key)
    two = jc.Problem(
        jc.FunctionPlant(lambda x, u, t: u, nx=2, nu=2), jc.QuadraticCost(), num_steps=3
    )
    for kind in (jc.SignalDependentNoise, jc.AdditiveNoise):  # one is not repeated for two
        with pytest.raises(ValueError, match=r"intensity: shape \(1,\)"):
            jc.simulate(two, jc.OpenLoop(jnp.ones((3, 2))), X0, key=key, noise=kind([0.1]))
    with pytest.raises(TypeError, match=r"noise: a noise such as jc.AdditiveNoise is wanted"):
        jc.simulate(problem(), control, X0, key=key, noise=0.1)


class Flat(jc.AbstractNoise):
    def __call__(self, plant, x, u, t):
        return 0.1 * x


def test_a_noise_that_is_no_matrix_is_named():
    with pytest.raises(ValueError, match=r"Flat: returned \(2,\), wanted \(2, nw\)"):
        jc.simulate(
            problem(), jc.OpenLoop(jnp.ones((T, 1))), X0, key=jax.random.key(0), noise=Flat()
        )


def test_a_plant_of_the_other_kind_of_time_is_refused():
    control = jc.OpenLoop(jnp.zeros((T, 1)))
    discrete = jc.FunctionPlant(lambda x, u, t: x, nx=2, nu=1, discrete=True)
    with pytest.raises(ValueError, match="plant: a discrete one for the problem of a continuous"):
        jc.simulate(problem(), control, X0, plant=discrete)
    steps = jc.Problem(discrete, jc.QuadraticCost(), num_steps=T)
    with pytest.raises(ValueError, match="plant: a continuous one for the problem of a discrete"):
        jc.simulate(steps, control, X0, plant=problem().plant)


def test_what_is_no_problem_or_no_state_is_named(solution):
    with pytest.raises(TypeError, match=r"problem: a jc.Problem is wanted"):
        jc.simulate(solution, solution.policy, X0)
    with pytest.raises(ValueError, match=r"belief: got shape \(3,\), wanted \(2,\)"):
        jc.simulate(problem(), solution.policy, X0, belief=np.zeros(3))
    with pytest.raises(ValueError, match=r"belief: not finite"):
        jc.simulate(problem(), solution.policy, X0, belief=[np.nan, 0.0])


GAIN = 1.0


def law(y):
    return -GAIN * y[:1]


class Following(jc.AbstractController):
    """A controller with a function of the user's, which names a global."""

    law: Any

    def init(self, problem, belief, key):
        return ()

    def step(self, memory, y, i, t, key):
        return memory, self.law(y)


def test_a_changed_global_is_seen_by_a_controllers_function_and_by_what_moves(monkeypatch):
    plant = jc.FunctionPlant(lambda x, u, t: u - GAIN * x, nx=1, nu=1)
    task = jc.Problem(plant, jc.QuadraticCost(Q=1.0), num_steps=3, dt=0.1)
    for gain in (1.0, 3.0, jnp.array(2.0)):
        monkeypatch.setitem(globals(), "GAIN", gain)
        xs = jc.simulate(task, Following(law), jnp.ones(1)).xs
        np.testing.assert_allclose(xs[:, 0], (1 - 0.2 * gain) ** np.arange(4), rtol=1e-12)
