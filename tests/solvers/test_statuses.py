"""Every way in which a solve can end says so, eagerly, under jit and lane by lane under vmap."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc


def pendulum(x, u, t, p):
    return jnp.array([x[1], 9.8 * jnp.sin(x[0]) - p["mu"] * x[1] + u[0]])


def quadratic(running_weight=1e-3, terminal_weight=1.0):
    return jc.QuadraticCost(R=running_weight, Qf=terminal_weight)


def swing(dynamics=pendulum, cost=None, **arguments):
    plant = jc.FunctionPlant(dynamics, nx=2, nu=1, params={"mu": 0.01})
    return jc.Problem(plant, cost or quadratic(), num_steps=30, dt=0.05, **arguments)


X0 = jnp.array([2.5, 0.0])


def reason(solution):
    return solution.status.name


def test_success_implies_what_it_says():
    solution = jc.solve(swing(), jc.ILQR(), X0)
    assert solution.status.ok and "converged" in solution.status.message
    problem = swing()
    xs = problem.rollout(X0, solution.us)
    np.testing.assert_allclose(xs, solution.xs, rtol=1e-12)
    np.testing.assert_allclose(problem.total_cost(xs, solution.us), solution.cost, rtol=1e-12)
    np.testing.assert_array_equal(solution.policy.us, solution.us)
    assert solution.gradient <= jc.ILQR().tolerances.resolve(jnp.float64)[0]


def test_cost_never_rises_and_history_is_padded():
    solution = jc.solve(swing(control_bounds=(-4.0, 4.0)), jc.ILQR(), X0)
    n = int(solution.num_steps) + 1
    cost = np.asarray(solution.history.cost)
    assert (np.diff(cost[:n]) <= 0).all()
    assert np.isnan(cost[n:]).all() and np.isfinite(cost[:n]).all()
    np.testing.assert_allclose(solution.cost, cost[n - 1], rtol=1e-13)


@pytest.mark.parametrize("max_steps", [0, 1, 3])
def test_max_steps_is_its_own_status_and_returns_the_best_iterate(max_steps):
    solution = jc.solve(swing(), jc.ILQR(), X0, max_steps=max_steps)
    assert reason(solution) == "MAX_STEPS" and not solution.status.ok
    assert int(solution.num_steps) == max_steps
    np.testing.assert_allclose(solution.cost, np.nanmin(solution.history.cost), rtol=1e-13)
    assert jnp.isfinite(solution.gradient)


def test_nearly_converged_is_its_own_status():
    full = jc.solve(swing(), jc.ILQR(), X0)
    solution = jc.solve(swing(), jc.ILQR(), X0, max_steps=int(full.num_steps) - 1)
    assert reason(solution) == "NEARLY_CONVERGED" and not solution.status.ok


def test_saddle_as_a_start_is_not_called_converged_without_a_note():
    # x' = -u^2 with the cost x(T) + small |u|^2: at u = 0 the gradient is zero and the curvature
    # negative, which Gauss and Newton's Hessian cannot see.
    def dynamics(x, u, t, p):
        return jnp.array([-(u[0] ** 2), 0.0])

    cost = jc.FunctionCost(running=lambda x, u, t: 0.1 * u @ u, terminal=lambda x: x[0])
    solution = jc.solve(swing(dynamics, cost), jc.ILQR(), X0)
    assert reason(solution) == "STATIONARY_START"
    assert "saddle" in solution.status.message
    assert int(solution.num_steps) == 0


def test_warm_start_at_the_optimum_takes_no_step():
    first = jc.solve(swing(), jc.ILQR(), X0)
    again = jc.solve(swing(), jc.ILQR(), X0, first.us)
    assert again.status.ok and int(again.num_steps) <= 1


def test_nan_input_under_jit_is_a_status_within_two_iterations():
    solve = eqx.filter_jit(lambda p, x: jc.solve(p, jc.ILQR(), x))
    bad_start = solve(swing(), X0.at[0].set(jnp.nan))
    assert reason(bad_start) == "NONFINITE_INPUT" and int(bad_start.num_steps) <= 2
    problem = eqx.tree_at(lambda p: p.plant.params["mu"], swing(), jnp.array(jnp.inf))
    assert reason(solve(problem, X0)) == "NONFINITE_INPUT"


def test_bounds_of_a_plant_may_be_infinite_but_not_nan():
    plant = jc.FunctionPlant(
        lambda x, u, t: pendulum(x, u, t, {"mu": 0.01}), nx=2, nu=1, control_bounds=(-jnp.inf, 2.0)
    )
    solve = eqx.filter_jit(lambda p: jc.solve(p, jc.ILQR(), X0))
    problem = jc.Problem(plant, quadratic(), num_steps=30, dt=0.05)
    half = solve(problem)
    assert half.status.ok and half.us.max() <= 2.0
    upper = jnp.full(1, jnp.nan)
    spoilt = eqx.tree_at(lambda p: p.plant.control_bounds[1], problem, upper)
    assert reason(solve(spoilt)) == "NONFINITE_INPUT"


def explosive(x, u, t, p):
    return jnp.array([x[1] ** 2, x[0] ** 3 + u[0]])


def test_divergence_of_the_start_names_the_dynamics_and_the_step():
    solution = jc.solve(swing(explosive), jc.ILQR(), jnp.array([50.0, 50.0]))
    assert reason(solution) == "NONFINITE_DYNAMICS"
    problem = swing(explosive)
    xs = problem.rollout(jnp.array([50.0, 50.0]), jnp.zeros((30, 1)))
    first_bad = int(np.argmax(~np.isfinite(xs).all(1)))
    assert int(solution.status.index) == first_bad - 1
    assert f"step {first_bad - 1} " in solution.status.message
    assert jnp.isfinite(solution.xs).all()
    np.testing.assert_array_equal(solution.xs[-1], xs[first_bad - 1])


def test_nan_cost_at_the_start_names_the_cost_and_the_step():
    cost = jc.FunctionCost(
        running=lambda x, u, t: jnp.where(t > 0.49, jnp.sqrt(-1.0 - t), u[0] ** 2)
    )
    solution = jc.solve(swing(cost=cost), jc.ILQR(), X0)
    assert reason(solution) == "NONFINITE_COST" and int(solution.status.index) == 10


def test_nan_derivative_names_itself():
    cost = jc.FunctionCost(running=lambda x, u, t: jnp.sqrt(u[0] ** 2) + u[0] ** 2)
    solution = jc.solve(swing(cost=cost), jc.ILQR(), X0)
    assert reason(solution) == "NONFINITE_DERIVATIVE" and int(solution.status.index) == 29
    assert int(solution.num_steps) <= 1


def test_nan_in_a_trial_step_is_rejected_and_the_solve_goes_on():
    def barrier(x, u, t):
        return 1e-3 * u[0] ** 2 - 1e-1 * jnp.log(1.2 + x[1] / 3.0)

    cost = jc.FunctionCost(running=barrier, terminal=lambda x: 20 * jnp.sum(x**2))
    solution = jc.solve(swing(cost=cost), jc.ILQR(), X0)
    fractions = np.asarray(solution.history.step)[1 : int(solution.num_steps) + 1]
    assert solution.status.ok and jnp.isfinite(solution.xs).all()
    assert (fractions < 1).any()


def test_indefinite_control_cost_is_regularised_or_reported():
    concave = jc.FunctionCost(
        running=lambda x, u, t: -1e-2 * jnp.sum(u**2) + 1e-3 * jnp.sum(u**4),
        terminal=lambda x: jnp.sum(x**2),
    )
    solution = jc.solve(swing(cost=concave), jc.ILQR(), X0, 0.1 * jnp.ones((30, 1)))
    n = int(solution.num_steps) + 1
    assert (np.diff(np.asarray(solution.history.cost)[:n]) <= 0).all()
    assert solution.status.ok
    unbounded = jc.FunctionCost(running=lambda x, u, t: -jnp.sum(u**2))
    solution = jc.solve(swing(cost=unbounded), jc.ILQR(), X0, 0.1 * jnp.ones((30, 1)), max_steps=50)
    assert not solution.status.ok


def test_singular_control_weight_is_solved_when_the_dynamics_make_up_for_it():
    cost = jc.QuadraticCost(Q=1.0, R=0.0, Qf=1.0)
    solution = jc.solve(swing(cost=cost), jc.ILQR(), X0)
    assert solution.status.ok
    nearly = jc.solve(swing(cost=jc.QuadraticCost(Q=1.0, R=1e-9, Qf=1.0)), jc.ILQR(), X0)
    np.testing.assert_allclose(solution.cost, nearly.cost, rtol=1e-4)


def test_infeasible_bounds_are_refused_or_a_status():
    with pytest.raises(
        ValueError, match=r"control_bounds: lower <= upper is wanted, got 2.0 > 1.0"
    ):
        swing(control_bounds=(2.0, 1.0))
    solve = jax.jit(lambda lo: jc.solve(swing(control_bounds=(lo, 1.0)), jc.ILQR(), X0))
    assert reason(solve(2.0)) == "INFEASIBLE_BOUNDS"
    assert solve(-1.0).status.ok


def test_equal_bounds_fix_the_controls():
    solution = jc.solve(swing(control_bounds=(0.7, 0.7)), jc.ILQR(), X0)
    np.testing.assert_array_equal(solution.us, 0.7)
    assert solution.status.ok


def test_horizon_of_one_step_is_exact():
    problem = jc.Problem(swing().plant, quadratic(0.5), num_steps=1, dt=0.05)
    solution = jc.solve(problem, jc.ILQR(), X0)
    # x1 = a + b u with b = (0, dt): minimise dt r u^2 / 2 + |x1|^2 / 2.
    a = problem.step(X0, jnp.zeros(1), 0.0)
    wanted = -0.05 * a[1] / (0.05 * 0.5 + 0.05**2)
    np.testing.assert_allclose(solution.us[0, 0], wanted, rtol=1e-9)


def test_one_bad_lane_is_flagged_and_leaves_the_others_alone():
    starts = jnp.stack([X0, X0.at[0].set(jnp.nan), jnp.array([1.0, 0.5]), jnp.array([9e9, 9e9])])
    solve = jax.jit(jax.vmap(lambda x: jc.solve(swing(), jc.ILQR(), x)))
    batch = solve(starts)
    np.testing.assert_array_equal(np.asarray(batch.status.ok)[:3], [True, False, True])
    for lane in (0, 2):
        solo = jc.solve(swing(), jc.ILQR(), starts[lane])
        np.testing.assert_allclose(batch.us[lane], solo.us, rtol=1e-8, atol=1e-8)
    swapped = solve(starts[::-1])
    np.testing.assert_array_equal(swapped.us[::-1], batch.us)
    assert "1 of 4 failed: x0" in str(batch)


def test_throw_raises_with_the_reason():
    with pytest.raises(jc.SolveError, match="maximum number of steps"):
        jc.solve(swing(), jc.ILQR(), X0, max_steps=2, throw=True)
    assert jc.solve(swing(), jc.ILQR(), X0, throw=True).status.ok
    with pytest.raises(RuntimeError, match="did not converge"):
        jax.jit(lambda x: jc.solve(swing(), jc.ILQR(), x, max_steps=2, throw=True).cost)(X0)


def test_a_second_solve_equals_the_first_bit_for_bit():
    problem, solver = swing(), jc.ILQR()
    first, second = jc.solve(problem, solver, X0), jc.solve(problem, solver, X0)
    jax.tree.map(np.testing.assert_array_equal, first, second)


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_scaling_the_cost_changes_no_control(scale):
    bounds = (-4.0, 4.0)
    plain = jc.solve(swing(control_bounds=bounds), jc.ILQR(), X0)
    cost = quadratic(1e-3 * scale, scale)
    scaled = jc.solve(swing(cost=cost, control_bounds=bounds), jc.ILQR(), X0)
    assert scaled.status.ok
    np.testing.assert_allclose(scaled.us, plain.us, rtol=1e-6, atol=1e-6)


def test_scaling_the_state_changes_no_control():
    s = 1e6
    plain = jc.solve(swing(), jc.ILQR(), X0)
    scaled = swing(lambda x, u, t, p: s * pendulum(x / s, u, t, p), quadratic(1e-3, 1 / s**2))
    np.testing.assert_allclose(
        jc.solve(scaled, jc.ILQR(), s * X0).us, plain.us, rtol=1e-6, atol=1e-6
    )


def test_tolerance_below_round_off_warns():
    with pytest.warns(UserWarning, match="cost_tolerance = 1e-17 is below 10 eps"):
        jc.solve(swing(), jc.ILQR(cost_tolerance=1e-17), X0)


def test_noise_in_the_problem_warns_that_ilqr_ignores_it():
    with pytest.warns(UserWarning, match="ignores the problem's noise"):
        jc.solve(swing(noise=jc.AdditiveNoise(0.1)), jc.ILQR(), X0)


def test_float32_reaches_the_float64_cost(float32):
    solution = jc.solve(swing(), jc.ILQR(), jnp.array([2.5, 0.0], jnp.float32))
    assert solution.us.dtype == jnp.float32 and solution.status.ok
    with jax.enable_x64(True):
        wanted = jc.solve(swing(), jc.ILQR(), jnp.array([2.5, 0.0])).cost
    np.testing.assert_allclose(solution.cost, wanted, rtol=1e-3)


def test_changing_any_number_does_not_trace_again():
    traces = []

    def counted(x, u, t, p):
        traces.append(1)
        return pendulum(x, u, t, p)

    plant = jc.FunctionPlant(counted, nx=2, nu=1, params={"mu": 0.01})

    def solve(mu, weight, bound, x0, dt):
        changed = eqx.tree_at(lambda p: p.params["mu"], plant, jnp.asarray(mu))
        cost = quadratic(weight)
        problem = jc.Problem(changed, cost, num_steps=20, dt=dt, control_bounds=(-bound, bound))
        return jc.solve(problem, jc.ILQR(), x0)

    solve(0.01, 1e-3, 5.0, [1.0, 0.0], 0.05)
    count = len(traces)
    solve(0.02, 2e-3, 4, jnp.array([2.0, 1.0]), 0.04)
    assert len(traces) == count


def test_user_exceptions_pass_with_a_line_of_help():
    def branching(x, u, t, p):
        return x if x[0] > 0 else -x

    with pytest.raises(jax.errors.TracerBoolConversionError) as caught:
        jc.solve(swing(branching), jc.ILQR(), X0)
    assert any("while plant was traced" in note for note in caught.value.__notes__)

    def failing(x, u, t):
        raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        jc.solve(swing(cost=jc.FunctionCost(running=failing)), jc.ILQR(), X0)


def test_wrong_output_shapes_of_user_functions_are_named():
    with pytest.raises(ValueError, match=r"plant: returned \(3,\), wanted \(2,\)"):
        jc.solve(swing(lambda x, u, t, p: jnp.zeros(3)), jc.ILQR(), X0)
    with pytest.raises(ValueError, match=r"^FunctionCost.terminal: returned \(2,\), wanted \(\)"):
        jc.solve(swing(cost=jc.FunctionCost(terminal=lambda x: x)), jc.ILQR(), X0)


@pytest.mark.parametrize(
    ("x0", "us", "match"),
    [
        (jnp.zeros((2, 1)), None, r"x0: got shape \(2, 1\), wanted \(2,\); drop the second axis"),
        (jnp.zeros((5, 2)), None, r"x0: got shape \(5, 2\), .*jax.vmap"),
        (jnp.zeros(3), None, r"x0: got shape \(3,\), wanted \(2,\)"),
        (X0, jnp.zeros((1, 30)), r"us: got shape \(1, 30\), wanted \(30, 1\); .*transpose"),
        (X0, jnp.zeros((31, 1)), r"us: got shape \(31, 1\), .*drop the last row"),
        (X0, jnp.zeros(30), r"us: got shape \(30,\), .*us\[:, None\]"),
        (X0, jnp.zeros((8, 30, 1)), r"us: got shape \(8, 30, 1\), .*jax.vmap"),
        (jnp.array([jnp.nan, 0]), None, r"x0: not finite at index \(0,\)"),
        (X0, jnp.zeros((30, 1)).at[4].set(jnp.inf), r"us: not finite at index \(4, 0\)"),
    ],
)
def test_wrong_shapes_and_values_are_refused_before_tracing(x0, us, match):
    with pytest.raises(ValueError, match=match):
        jc.solve(swing(), jc.ILQR(), x0, us)


def test_wrong_types_are_refused_by_name():
    with pytest.raises(TypeError, match=r"x0: .* wanted, got None"):
        jc.solve(swing(), jc.ILQR(), None)  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"x0: .*complex"):
        jc.solve(swing(), jc.ILQR(), jnp.array([1j, 0]))
    with pytest.raises(TypeError, match=r"solver: .*ILQR\(\) with parentheses"):
        jc.solve(swing(), jc.ILQR, X0)
    with pytest.raises(TypeError, match=r"plant: .*jc.FunctionPlant"):
        jc.Problem(pendulum, quadratic(), num_steps=3)
    with pytest.raises(TypeError, match=r"cost: .*jc.FunctionCost"):
        jc.Problem(swing().plant, lambda x: x, num_steps=3)
    with pytest.raises(ValueError, match="max_steps"):
        jc.solve(swing(), jc.ILQR(), X0, max_steps=-1)


@pytest.mark.parametrize(
    ("arguments", "error", "match"),
    [
        ({"num_steps": 0}, ValueError, "num_steps: at least 1"),
        ({"num_steps": 2.5}, TypeError, "num_steps: an integer"),
        ({"dt": 0.0}, ValueError, "dt: a positive time step"),
        ({"dt": jnp.ones(3)}, ValueError, "dt: one number"),
        ({"control_bounds": (0.0,)}, ValueError, "control_bounds: a pair"),
        ({"control_bounds": (jnp.zeros(2), 1.0)}, ValueError, r"lower bound has shape \(2,\)"),
        ({"control_bounds": (jnp.nan, 1.0)}, ValueError, "lower <= upper"),
        ({"integrator": jc.NextState()}, ValueError, "integrator: NextState does not fit"),
    ],
)
def test_problems_that_make_no_sense_are_refused(arguments, error, match):
    with pytest.raises(error, match=match):
        jc.Problem(swing().plant, quadratic(), **{"num_steps": 5, "dt": 0.1, **arguments})


def test_nonfinite_parameter_is_refused_by_its_name():
    plant = jc.FunctionPlant(pendulum, nx=2, nu=1, params={"mu": jnp.nan})
    problem = jc.Problem(plant, quadratic(), num_steps=5)
    with pytest.raises(ValueError, match=r"problem: plant.*mu.* is not finite"):
        jc.solve(problem, jc.ILQR(), X0)


def test_batched_problem_is_refused_with_a_hint():
    problems = jax.vmap(lambda dt: jc.Problem(swing().plant, quadratic(), num_steps=5, dt=dt))(
        jnp.array([0.1, 0.2])
    )
    with pytest.raises(ValueError, match=r"problem: .*jax.vmap"):
        jc.solve(problems, jc.ILQR(), X0)


def test_dtypes_are_promoted_to_the_widest():
    solution = jc.solve(swing(), jc.ILQR(), np.array([2, 0]))
    assert solution.us.dtype == jnp.float64
    solution = jc.solve(swing(), jc.ILQR(), jnp.array([2.0, 0.0], jnp.float32))
    assert solution.us.dtype == jnp.float64


def test_solve_prints_nothing_and_solutions_print_a_table(capsys):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solution = jc.solve(swing(), jc.ILQR(), X0)
    assert capsys.readouterr().out == ""
    text = str(solution)
    for word in ("converged", "cost", "gradient", "iterations", "reason"):
        assert word in text


@pytest.mark.parametrize("solver", [jc.ILQR(), jc.DDP()])
def test_a_printed_solution_says_how_many_controls_lie_on_bounds(solver):
    plant, cost = swing().plant, quadratic()
    bounded = jc.Problem(plant, cost, num_steps=30, dt=0.1, control_bounds=(-0.3, 0.3))
    solution = jc.solve(bounded, solver, X0)
    held = (jnp.abs(solution.us) == 0.3) & (solution.policy.K == 0).all(axis=-1)
    assert 0 < held.sum() <= 30
    assert f"  at bounds  {held.sum()} of 30 controls, whose gains are zero\n" in str(solution)
    loose = jc.Problem(plant, cost, num_steps=30, dt=0.1, control_bounds=(-1e3, 1e3))
    free = jc.Problem(plant, cost, num_steps=30, dt=0.1)
    for problem in (loose, free):
        assert "at bounds" not in str(jc.solve(problem, solver, X0))
    several = jax.vmap(lambda x0: jc.solve(bounded, solver, x0))(jnp.stack([X0, 0.5 * X0]))
    assert "at bounds" not in str(several)


def test_user_functions_of_the_wrong_form_are_answered_with_advice():
    with pytest.raises(TypeError, match="plant: returned a list, wanted one array"):
        jc.solve(swing(lambda x, u, t, p: [x[1], u[0]]), jc.ILQR(), X0)
    with pytest.raises(TypeError) as caught:
        jc.solve(swing(lambda x, u, t: x), jc.ILQR(), X0)
    assert any("dynamics(x, u, t)" in note for note in caught.value.__notes__)
    with pytest.raises(jax.errors.TracerBoolConversionError) as caught:
        jc.solve(swing(lambda x, u, t, p: x if x[0] > 0 else -x), jc.ILQR(), X0)
    assert any("jnp.where" in note for note in caught.value.__notes__)


def test_bounds_and_targets_of_the_wrong_form_are_named():
    with pytest.raises(ValueError, match=r"control_bounds: a pair .* got 1.0"):
        swing(control_bounds=1.0)
    problem = swing(cost=jc.QuadraticCost(Qf=1.0, target=jnp.zeros(3)))
    with pytest.raises(ValueError, match=r"target: shape \(3,\), wanted \(\) or \(2,\)"):
        jc.solve(problem, jc.ILQR(), X0)


@pytest.mark.parametrize("value", [-1.0, float("nan")])
def test_a_tolerance_that_is_none_is_refused(value):
    for solver in (jc.ILQR(gradient_tolerance=value), jc.LBFGS(cost_tolerance=value)):
        with pytest.raises(ValueError, match="_tolerance: a number >= 0 is wanted"):
            jc.solve(swing(), solver, X0)
