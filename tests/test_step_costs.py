"""Costs of what changes over a step: their expansion, their derivatives, and why they exist."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import gradient

import jaxctrl as jc
from jaxctrl.linear import costates, lqr, lqr_rollout


class Change(jc.AbstractRate, jc.AbstractResidual, jc.AbstractEnd):
    """The change of a curved function of the state, which the control and the time enter too."""

    weight: jax.Array

    def residual(self, plant, at):
        def curved(x):
            return jnp.stack([jnp.sin(2 * x[0]) + x[1], x[0] * x[1], x[1] ** 2 * at.u[0]])

        return self.weight * (1 + at.s) * (curved(at.after) - curved(at.x)) / at.dt

    def rate(self, plant, at):
        return 0.8 * jnp.sum(at.u**2) + 0.1 * at.x[0] ** 4 * (1 + at.t)

    def end(self, plant, x):
        return jnp.sum((x - 1) ** 2) + 0.1 * x[0] ** 4


def dynamics(x, u, t, p):
    force = p * jnp.sin(x[0]) + u[0] * jnp.cos(x[1] + t) + 0.3 * u[1] ** 2
    return jnp.array([x[1] + 0.2 * u[1], force])


X0 = jnp.array([0.4, -0.3])
US = jnp.asarray(np.random.default_rng(0).normal(size=(6, 2)))


def problem(integrator=None, weight=0.3, discrete=False):
    def step(x, u, t, p):
        return x + 0.1 * dynamics(x, u, t, p)

    plant = jc.FunctionPlant(
        step if discrete else dynamics, nx=2, nu=2, params=3.0, discrete=discrete
    )
    events = jc.FunctionCost(
        event=lambda x, i: (1.0 + i) * (jnp.sin(x[0]) - 0.2) ** 2, event_times=[0.1, 0.23, 0.6]
    )
    cost = Change(jnp.asarray(weight)) + (events + Change(jnp.asarray(0.1)))
    return jc.Problem(plant, cost, num_steps=6, dt=0.1, integrator=integrator)


def by_hand(problem, x0, us):
    """The total cost, written as a loop."""
    x, total, dt = x0, 0.0, 1.0 if problem.plant.discrete else problem.dt
    xs = [x]
    for k, u in enumerate(us):
        after = problem.step(x, u, k * problem.dt)
        at = jc.At(x, u, after, k * problem.dt, k, problem.dt, k / len(us))
        for part in jc.parts(problem.cost)[::2]:
            rho = part.residual(problem.plant, at)
            total += dt * 0.5 * sum(rho[i] ** 2 for i in range(3))
            total += dt * part.rate(problem.plant, at)
        x = after
        xs.append(x)
    xs = jnp.stack(xs)
    for i, time in enumerate(np.array([0.1, 0.23, 0.6])):
        k = min(int(np.floor(time / 0.1 + 1e-9)), len(us) - 1)
        f = time / problem.dt - k
        y = (1 - f) * xs[k] + f * xs[k + 1]
        total += (1 + i) * (jnp.sin(y[0]) - 0.2) ** 2
    return total + 2 * (jnp.sum((x - 1) ** 2) + 0.1 * x[0] ** 4)


@functools.lru_cache
def dense(kind):
    prob = CASES[kind]()

    def cost(flat):
        us = flat.reshape(US.shape)
        return prob.total_cost(prob.rollout(X0, us), us)  # which is the cost by hand, see below

    return jax.jit(lambda us: (jax.grad(cost)(us), jax.hessian(cost)(us)))(US.ravel())


CASES = {
    "Euler": lambda: problem(jc.Euler()),
    "RK4": lambda: problem(jc.RK4()),
    "discrete": lambda: problem(discrete=True),
}


@eqx.filter_jit
def newton(prob, us=US, second_order=False):
    """The gradient of the model, and its step in all controls."""
    model = jc.expand(prob, prob.rollout(X0, us), us, second_order=second_order)
    sweep = lqr(model)
    _, dus = lqr_rollout(model, sweep.k, sweep.K, jnp.zeros(2))
    return costates(model)[1].ravel(), dus.ravel()


@pytest.mark.parametrize(
    "kind", ["Euler", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("RK4", "discrete"))]
)
def test_the_exact_expansion_is_the_gradient_and_hessian_of_the_whole_cost(kind):
    prob = CASES[kind]()
    g, H = dense(kind)
    assert np.linalg.eigvalsh(H)[0] > 0
    np.testing.assert_allclose(gradient(prob, X0, US).ravel(), g, rtol=1e-9, atol=1e-12)
    got, step = newton(prob, second_order=True)
    np.testing.assert_allclose(got, g, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(step, -np.linalg.solve(H, g), rtol=1e-8, atol=1e-10)


def test_the_first_order_expansion_has_the_gradient_and_the_step_of_gauss_and_newton():
    prob = problem()
    g, H = dense("Euler")
    got, step = newton(prob)
    np.testing.assert_allclose(got, g, rtol=1e-9, atol=1e-12)
    assert np.abs(step + np.linalg.solve(H, g)).max() > 1e-3

    # Of dynamics that are linear and rates that are quadratic J'J is all there is besides.
    class Curved(jc.AbstractRate, jc.AbstractResidual, jc.AbstractEnd):
        def residual(self, plant, at):
            turned = jnp.sin(at.after) - jnp.sin(at.x)
            return (turned + 0.1 * jnp.concatenate([at.u, at.u]) ** 2) / at.dt

        def rate(self, plant, at):
            return 0.5 * jnp.sum(at.u**2)

        def end(self, plant, x):
            return 0.5 * jnp.sum((x - 1) ** 2)

    plant = jc.FunctionPlant(lambda x, u, t: jnp.array([x[1], u[0]]), nx=2, nu=1)
    prob, us = jc.Problem(plant, Curved(), num_steps=6, dt=0.1), US[:, :1]

    def residuals(us):
        xs = [X0]
        for u in us.reshape(6, 1):
            xs.append(xs[-1] + 0.1 * jnp.array([xs[-1][1], u[0]]))
        xs = jnp.stack(xs)
        change = jnp.sin(xs[1:]) - jnp.sin(xs[:-1]) + 0.1 * us.reshape(6, 1) ** 2
        return jnp.concatenate(
            [jnp.sqrt(0.1) * change.ravel() / 0.1, jnp.sqrt(0.1) * us, xs[-1] - 1]
        )

    flat = us.ravel()
    J, r = jax.jacfwd(residuals)(flat), residuals(flat)
    got, step = newton(prob, us)
    np.testing.assert_allclose(got, J.T @ r, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(step, -np.linalg.solve(J.T @ J, J.T @ r), rtol=1e-8)


def test_a_traced_choice_of_order_gives_both_models():
    prob = problem()
    xs = prob.rollout(X0, US)
    expand = jax.jit(lambda exact: jc.expand(prob, xs, US, second_order=exact))
    known = jax.jit(lambda exact: jc.expand(prob, xs, US, second_order=exact), static_argnums=0)
    for exact in (True, False):
        both = jax.tree.leaves(expand(exact)), jax.tree.leaves(known(exact))
        for a, b in zip(*both, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("kind", CASES)
def test_stage_costs_add_up_to_the_cost_by_hand(kind):
    prob = CASES[kind]()
    xs = prob.rollout(X0, US)
    stages = prob.stage_costs(xs, US)
    assert stages.shape == (7,)
    np.testing.assert_allclose(jnp.sum(stages), by_hand(prob, X0, US), rtol=1e-12)
    np.testing.assert_allclose(prob.total_cost(xs, US), by_hand(prob, X0, US), rtol=1e-12)


def test_a_step_counts_its_own_residual():
    prob, without = problem(weight=0.3), problem(weight=0.0)
    xs = prob.rollout(X0, US)
    got = prob.stage_costs(xs, US) - without.stage_costs(xs, US)
    part = Change(jnp.asarray(0.3))
    rho = [
        part.residual(None, jc.At(xs[k], US[k], xs[k + 1], 0.1 * k, k, 0.1, k / 6))
        for k in range(6)
    ]
    wanted = [0.05 * float(jnp.sum(r**2)) for r in rho]
    np.testing.assert_allclose(got, [*wanted, 0.0], rtol=1e-10, atol=1e-12)


def test_parts_of_nested_sums_are_found_in_order():
    a, b, c = (Change(jnp.asarray(float(i))) for i in range(3))
    plain = jc.QuadraticCost(R=1.0)
    whole = (a + plain) + (b + (plain + c))
    found = jc.parts(whole)
    assert [found[i] is part for i, part in enumerate((a, plain, b, plain, c))] == 5 * [True]
    assert len(jc.terms(whole).residuals) == 3 and len(jc.terms(whole).rates) == 5
    assert jc.parts(plain) == (plain,)


class Wrong(jc.AbstractResidual):
    """A residual of any kind."""

    kind: str

    def residual(self, plant, at):
        change = (at.after - at.x) / at.dt
        return {
            "scalar": lambda: jnp.sum(change),
            "column": lambda: change[:, None],
            "tuple": lambda: (change, change),
            "float32": lambda: change.astype(jnp.float32),
            "crash": lambda: change @ jnp.ones(7),
        }[self.kind]()


@pytest.mark.parametrize(
    ("kind", "error", "match"),
    [
        ("scalar", ValueError, r"^Wrong.residual: returned \(\), wanted \(m,\)"),
        ("column", ValueError, r"^Wrong.residual: returned \(2, 1\), wanted \(m,\)"),
        ("tuple", TypeError, r"^Wrong.residual: returned a tuple, wanted one array \(m,\)"),
        ("float32", TypeError, "^Wrong.residual: returned float32 from float64"),
        ("crash", TypeError, "dot_general"),
    ],
)
def test_a_residual_of_another_shape_is_refused_by_the_name_of_its_cost(kind, error, match):
    plant = jc.FunctionPlant(dynamics, nx=2, nu=2, params=3.0)
    cost = jc.QuadraticCost(R=1.0) + Wrong(kind)
    with pytest.raises(error, match=match) as caught:
        jc.solve(jc.Problem(plant, cost, num_steps=6, dt=0.1), jc.ILQR(), X0)
    if kind == "crash":
        assert any("while Wrong.residual was traced" in note for note in caught.value.__notes__)


def _torque_change(num_steps=12):
    arm = jc.plants.TorqueArm()
    task = jc.tasks.reach(arm, jnp.array([-0.1, 0.53]), 0.5, num_steps=num_steps)
    model = jc.models.MinimumTorqueChange()
    return model.problem(task), model.start(task, arm.at_rest(0.785, 1.571))


def _check_gradients(where):
    prob, x0 = _torque_change()
    report = jc.check_gradients(prob, jc.DDP(gradient_tolerance=1e-9), x0, where=where)
    print(report)
    assert report.worst < 1e-5
    names = {row.name for row in report.rows}
    assert {"x0", "dt"} <= names and any(name.endswith(".weight") for name in names)


@pytest.mark.slow
def test_derivatives_of_a_solve_with_a_step_cost_agree_with_differences():
    _check_gradients(lambda name: name in ("x0", "dt") or name.endswith(".weight"))


@pytest.mark.slow
def test_derivatives_by_every_number_agree_with_differences():
    _check_gradients(None)


def test_a_weight_of_zero_has_a_derivative():
    """At zero the slope of sqrt(w) is infinite."""
    prob, x0 = _torque_change()
    us = 0.1 + 0 * prob.nominal_controls
    xs = prob.rollout(x0, us)

    def cost(weight):
        part = jc.models.TorqueChange(weight)
        whole = jc.Problem(prob.plant, part, num_steps=12, dt=prob.dt)
        return whole.total_cost(xs, us)

    slope = jax.grad(cost)
    np.testing.assert_allclose(slope(0.0), cost(1.0), rtol=1e-9)
    np.testing.assert_allclose(slope(1.0), cost(1.0), rtol=1e-9)


# Why the change over a step and not a derivative at its beginning: muscles.


def _rate(arm, weight):
    """The derivative form, |dtau/dx f(x, u)|^2/2 per second."""

    def running(x, u, t):
        rate = jax.jvp(arm.muscle_torque, (x,), (arm(x, u, t),))[1]
        return 0.5 * weight * jnp.sum(rate**2)

    return jc.FunctionCost(running=running)


def _both_forms(arm, xs, us, dt=0.01):
    """The cost of torque change by derivatives, by differences, and from NumPy's differences."""
    costs = []
    for cost in (_rate(arm, 1.0), jc.models.TorqueChange(1.0)):
        whole = jc.Problem(arm, cost, num_steps=len(us), dt=dt)
        costs.append(float(jax.jit(lambda xs, us, whole=whole: whole.total_cost(xs, us))(xs, us)))
    torques = np.asarray(jax.jit(jax.vmap(lambda x: arm.muscle_torque(x)))(xs))
    return *costs, 0.5 * np.sum(np.diff(torques, axis=0) ** 2) / dt


def test_a_muscle_switched_on_from_rest_changes_its_torque_but_no_derivative_of_it():
    """Brown's force is flat at no activation: one step on, then held, is free of charge."""
    arm = jc.plants.MuscleArm(active_state="brown")
    x0 = arm.at_rest(0.785, 1.571)
    problem = jc.Problem(arm, jc.QuadraticCost(), num_steps=3, dt=0.01)
    rollout = jax.jit(lambda x0, us: problem.rollout(x0, us))
    one = jnp.zeros((3, 6)).at[0, 2].set(1.0)
    held = float(rollout(x0, one)[1, 6])
    us = one.at[1:, 2].set(held)  # u = a: the activation stays
    xs = rollout(x0, us)
    torque = jax.jit(lambda x: arm.muscle_torque(x))
    change = np.abs(torque(xs[1]) - torque(x0)).max()
    derivative, difference, plain = _both_forms(arm, xs, us)
    print(f"activation {held:.3f}, torque {change:.3f} N m; {derivative:.4g}, {difference:.4g}")
    np.testing.assert_allclose(difference, plain, rtol=1e-9)
    assert change > 0.1 and difference > 30 * derivative


@pytest.mark.slow
def test_an_optimum_of_the_derivative_form_exploits_it_and_one_of_differences_cannot():
    arm = jc.plants.MuscleArm(active_state="brown")
    x0, target = arm.at_rest(0.785, 1.571), jnp.array([-0.1, 0.53])
    task = jc.tasks.reach(arm, target, 0.5, effort=1e-5)
    ratios = {}
    for name, cost in (("derivative", _rate(arm, 1e-7)), ("difference", jc.models.TorqueChange())):
        prob = jc.Problem(arm, task.cost + cost, num_steps=50, dt=0.01)
        solution = jc.solve(prob, jc.ILQR(), x0, max_steps=500)
        forms = _both_forms(arm, solution.xs, solution.us)
        error = 1e3 * float(jnp.linalg.norm(arm.hand(solution.xs[-1]) - target))
        print(f"{name}: {solution.status.name}, {error:.2f} mm, {forms[0]:.4g} {forms[1]:.4g}")
        ratios[name] = forms[1] / forms[0]
    assert ratios["derivative"] > 3 * ratios["difference"], ratios
