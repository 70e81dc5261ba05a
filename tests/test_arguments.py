"""Arguments that cannot be meant are refused by name; NumPy's integers are integers."""

# pyright: reportArgumentType=false

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc
from jaxctrl import _solve

X0 = jnp.array([1.0, 0.0])


def dynamics(x, u, t):
    return jnp.array([x[1], u[0]])


def plant(**arguments):
    return jc.FunctionPlant(dynamics, **{"nx": 2, "nu": 1, **arguments})


def problem(**arguments):
    cost = jc.QuadraticCost(Q=1.0, R=1.0)
    return jc.Problem(plant(), cost, **{"num_steps": 5, "dt": 0.1, **arguments})


NO_NUMBERS = {
    "text": ("0.1", "'0.1'"),
    "None": (None, "None"),
    "ragged": ([[1.0], [1.0, 2.0]], "real number"),
    "object": (object(), "real number"),
    "complex": (1j, "complex"),
    "float16": (np.float16(0.1), "float16; that is too coarse"),
    "bfloat16": (jnp.bfloat16(0.1), "bfloat16; that is too coarse"),
}
PLACES = {
    "dt": lambda v: problem(dt=v),
    "control_bounds": lambda v: problem(control_bounds=(v, 1.0)),
    "nominal_control": lambda v: plant(nominal_control=v),
    "event_times": lambda v: jc.FunctionCost(event=lambda x, i: x @ x, event_times=v),
    "Q": lambda v: jc.QuadraticCost(Q=v),
    "intensity": lambda v: jc.AdditiveNoise(v),
    "x0": lambda v: jc.solve(problem(), jc.ILQR(), v),
    "effort": lambda v: jc.tasks.reach(jc.plants.TorqueArm(), [0.3, 0.3], effort=v),
    "target": lambda v: jc.tasks.reach(jc.plants.TorqueArm(), v),
    "duration": lambda v: jc.tasks.reach(jc.plants.TorqueArm(), [0.3, 0.3], v),
    "friction": lambda v: jc.plants.Pendulum(friction=v),
}


@pytest.mark.parametrize("kind", NO_NUMBERS)
@pytest.mark.parametrize("name", PLACES)
def test_what_is_no_number_is_refused_by_name(name, kind):
    value, says = NO_NUMBERS[kind]
    with pytest.raises((TypeError, ValueError), match=f"^{name}: ") as caught:
        PLACES[name](value)
    assert says in str(caught.value) or value is None


@pytest.mark.parametrize(
    "name", [name for name in PLACES if name not in ("event_times", "Q", "intensity")]
)
def test_an_empty_list_is_no_number(name):
    with pytest.raises((TypeError, ValueError), match=f"^{name}: "):
        PLACES[name]([])


def test_an_empty_list_or_text_is_no_control():
    for us in ([], "fast", [[1.0], [1.0, 2.0]]):
        with pytest.raises((TypeError, ValueError), match=r"^us: "):
            jc.solve(problem(), jc.ILQR(), X0, us)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"noise": 0.1}, r"^noise: jc.SignalDependentNoise or its like is wanted, got 0.1"),
        ({"noise": jc.AdditiveNoise}, r"^noise: .*AdditiveNoise\(\) with parentheses"),
        ({"integrator": "rk4"}, r"^integrator: jc.RK4\(\) .* got 'rk4'"),
        ({"integrator": jc.RK4}, r"^integrator: .*RK4\(\) with parentheses"),
        ({"num_steps": 2.0}, "^num_steps: an integer is wanted, got 2.0"),
        ({"num_steps": True}, "^num_steps: an integer is wanted, got True"),
        ({"num_steps": "5"}, "^num_steps: an integer is wanted"),
    ],
)
def test_a_problem_refuses_what_it_cannot_mean(arguments, match):
    with pytest.raises(TypeError, match=match):
        problem(**arguments)


@pytest.mark.parametrize("name", ["nx", "nu"])
def test_a_plant_has_at_least_one_state_and_one_control(name):
    with pytest.raises(ValueError, match=f"^{name}: at least 1 is wanted, got 0"):
        plant(**{name: 0})
    for value in (1.0, True, None):
        with pytest.raises(TypeError, match=f"^{name}: an integer is wanted"):
            plant(**{name: value})


@pytest.mark.parametrize("value", ["f", None, 1.0, jc.plants.Pendulum])
def test_dynamics_and_costs_are_functions(value):
    with pytest.raises(TypeError, match=r"^dynamics: a function is wanted"):
        jc.FunctionPlant(value, nx=1, nu=1)
    if value is not None:
        with pytest.raises(TypeError, match=r"^running: a function is wanted"):
            jc.FunctionCost(value)


def test_limits_of_the_iterations_are_integers_that_fit_into_memory():
    for value in (1e9, True, "9", None):
        with pytest.raises(TypeError, match=r"^max_steps: an integer is wanted"):
            jc.solve(problem(), jc.ILQR(), X0, max_steps=value)
        with pytest.raises(TypeError, match=r"^max_steps: an integer is wanted"):
            jc.solve_batch(problem(), jc.ILQR(), X0[None], max_steps=value)
    with pytest.raises(ValueError, match=r"^max_steps: .* would take 32 GB of memory"):
        jc.solve(problem(), jc.ILQR(), X0, max_steps=10**9)
    for value in (-1, 0):
        with pytest.raises(ValueError, match=r"^chunk: at least 1 is wanted"):
            jc.solve_batch(problem(), jc.ILQR(), X0[None], chunk=value)
    with pytest.raises(TypeError, match=r"^chunk: an integer is wanted, got 2.0"):
        jc.solve_batch(problem(), jc.ILQR(), X0[None], chunk=2.0)
    with pytest.raises(TypeError, match=r"^memory: an integer is wanted, got True"):
        jc.LBFGS(memory=True)
    with pytest.raises(TypeError, match=r"^n: an integer is wanted, got 2.0"):
        jc.plants.Chain(2.0)


def test_integers_of_numpy_are_integers():
    eight = np.int64(8)
    made = jc.Problem(
        plant(nx=np.int64(2), nu=np.int32(1)), jc.QuadraticCost(R=1.0), num_steps=eight
    )
    assert jc.solve(made, jc.LBFGS(memory=eight), X0, max_steps=eight).us.shape == (8, 1)
    assert jc.plants.Chain(np.int64(2)).nx == 4
    arm = jc.plants.TorqueArm()
    assert jc.tasks.reach(arm, [0.3, 0.3], num_steps=eight).num_steps == 8
    assert jc.tasks.centre_out(arm, arm.at_rest(0.8, 1.5), n=np.int64(2)).dt.shape == (2,)


def test_bounds_of_the_plant_are_in_use_and_replaced_as_the_help_says():
    assert "eqx.tree_at(lambda p: p.plant.control_bounds, problem, " in (jc.Problem.__doc__ or "")
    assert "`problem.bounds` are those in use" in (jc.Problem.__doc__ or "")
    arm = jc.plants.TorqueArm(control_bounds=(-1.0, 1.0))
    task = jc.tasks.posture(arm, [1.0, 1.5], num_steps=4)
    assert task.control_bounds is None
    lower, upper = jnp.array([-2.0, -3.0]), jnp.array([2.0, 3.0])
    other = eqx.tree_at(lambda p: p.plant.control_bounds, task, (lower, upper))
    np.testing.assert_array_equal(other.bounds, [jnp.tile(lower, (4, 1)), jnp.tile(upper, (4, 1))])


def test_a_time_step_put_in_later_is_checked_again():
    for dt in (0.0, -0.1):
        edited = eqx.tree_at(lambda p: p.dt, problem(), jnp.asarray(dt))
        with pytest.raises(ValueError, match=r"^dt: a positive time step is wanted"):
            jc.solve(edited, jc.ILQR(), X0)
        with pytest.raises(ValueError, match=r"^dt: a positive time step is wanted"):
            jc.simulate(edited, jc.OpenLoop(jnp.zeros((5, 1))), X0)
    crossed = (jnp.ones(1), -jnp.ones(1))
    edited = eqx.tree_at(lambda p: p.control_bounds, problem(control_bounds=(-1, 1)), crossed)
    with pytest.raises(ValueError, match=r"^control_bounds: lower <= upper is wanted"):
        jc.solve(edited, jc.ILQR(), X0)


def test_a_traced_time_step_that_is_not_positive_is_a_status_with_no_gradient():
    def solve(dt):
        solution = jc.solve(problem(dt=dt), jc.ILQR(), X0)
        return solution.cost, solution.status.code

    lanes = jnp.array([-0.1, 0.0, 0.1, jnp.nan])
    (_, codes), slopes = jax.jit(jax.vmap(jax.value_and_grad(solve, has_aux=True)))(lanes)
    names = [jc.Reason(int(code)).name for code in codes]
    assert names[:2] == ["INVALID_TIME_STEP"] * 2 and names[3] == "NONFINITE_INPUT"
    np.testing.assert_array_equal(jnp.isnan(slopes), [True, True, False, True])
    run = lambda dt: jc.simulate(problem(dt=dt), jc.OpenLoop(jnp.zeros((5, 1))), X0).cost  # noqa: E731
    np.testing.assert_array_equal(jnp.isnan(jax.vmap(run)(lanes)), [True, True, False, True])


@pytest.mark.parametrize(
    "task",
    [
        lambda arm: jc.tasks.reach(arm, [0.3, 0.3], 500.0),
        lambda arm: jc.tasks.posture(arm, [0.5, 0.5], 800),
        lambda arm: jc.tasks.via(arm, [0.3, 0.3], [[0.3, 0.2]], [250.0], 500.0),
        lambda arm: jc.tasks.centre_out(arm, arm.at_rest(0.8, 1.5), duration=500.0),
        lambda arm: jc.tasks.track(arm, [[0.3, 0.3], [0.3, 0.2]], 3000.0),
    ],
)
def test_durations_that_can_only_be_milliseconds_are_refused(task):
    with pytest.raises(ValueError, match=r"^duration: .*are these seconds, or milliseconds\?"):
        task(jc.plants.TorqueArm())


def test_a_number_put_in_by_tree_at_is_an_array_again():
    def springy(x, u, t, p):
        return jnp.array([x[1], u[0] - p["k"] * x[0]])

    def made(k):
        cost = jc.QuadraticCost(Q=1.0, R=1.0)
        plant = jc.FunctionPlant(springy, nx=2, nu=1, params={"k": k})
        return jc.Problem(plant, cost, num_steps=5, dt=0.1)

    task, number = made(1.0), lambda p: p.plant.params["k"]
    jc.solve(task, jc.ILQR(), X0)
    halved = made(0.5)
    wanted = float(jc.solve(halved, jc.ILQR(), X0).cost)
    size = _solve.run_iteration._cached._cache_size()
    for value in (0.5, np.float64(0.5), np.array(0.5)):
        edited = eqx.tree_at(number, task, value)
        assert float(jc.solve(edited, jc.ILQR(), X0).cost) == wanted
    assert _solve.run_iteration._cached._cache_size() == size
    for where, name in ((number, "k"), (lambda p: p.dt, "dt")):
        with pytest.raises(ValueError, match=name):
            jc.solve(eqx.tree_at(where, task, np.nan), jc.ILQR(), X0)
        with pytest.raises(TypeError, match=r"number.* is wanted, got 'a'"):
            jc.solve(eqx.tree_at(where, task, "a"), jc.ILQR(), X0)
