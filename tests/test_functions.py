"""User functions: what they close over has gradients, and is never served from a cache."""

import argparse
import collections
import enum
import functools
import types
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc
from jaxctrl._bytecode import is_own
from jaxctrl._function import Function

X0 = jnp.array([1.0, 0.0])
STEPS = {"num_steps": 8, "dt": 0.1}
gain = 2.0
theta_of_module = jnp.array(0.5)


def helper(x):
    return gain * x


def solve(dynamics, running=None, solver=None, x0=X0, **params):
    plant = jc.FunctionPlant(dynamics, nx=2, nu=1, params=params.get("params"))
    cost = jc.FunctionCost(
        running or (lambda x, u, t: x @ x + 0.1 * u @ u),
        lambda x: 5 * x @ x,
        params=params.get("weights"),
    )
    return jc.solve(jc.Problem(plant, cost, **STEPS), solver or jc.ILQR(), x0)


def pendulum(x, u, theta):
    return jnp.array([x[1], u[0] - theta[0] * jnp.sin(x[0]) - theta[1] * x[1]])


def closing(theta):
    dynamics = lambda x, u, t: pendulum(x, u, theta)  # noqa: E731
    running = lambda x, u, t: theta[2] * x @ x + 0.1 * u @ u  # noqa: E731
    return solve(dynamics, running).cost


@jax.jit
def by_params(theta):
    dynamics = lambda x, u, t, p: pendulum(x, u, p)  # noqa: E731
    plant = jc.FunctionPlant(dynamics, nx=2, nu=1, params=theta)
    running = lambda x, u, t, p: p[2] * x @ x + 0.1 * u @ u  # noqa: E731
    cost = jc.FunctionCost(running, lambda x, p: 5 * x @ x, params=theta)
    return jc.solve(jc.Problem(plant, cost, **STEPS), jc.ILQR(), X0).cost


THETA = jnp.array([1.0, 0.2, 1.5])


@pytest.fixture(scope="module")
def wanted():
    return jax.jit(jax.grad(by_params))(THETA)


def test_differences_agree_with_params(wanted):
    h = 1e-5 * jnp.eye(3)
    differences = [(by_params(THETA + e) - by_params(THETA - e)) / 2e-5 for e in h]
    assert np.linalg.norm(wanted - jnp.stack(differences)) <= 1e-6 * np.linalg.norm(wanted)


def transformed():
    return {
        "grad": jax.grad(closing),
        "grad of jit": jax.grad(jax.jit(closing)),
        "jit of grad": jax.jit(jax.grad(closing)),
        "vmap of grad": lambda theta: jax.vmap(jax.grad(closing))(theta[None])[0],
        "forward": jax.jacfwd(closing),
    }


@pytest.mark.parametrize("name", transformed())
def test_a_number_closed_over_has_the_gradient_that_it_has_in_params(name, wanted):
    np.testing.assert_allclose(transformed()[name](THETA), wanted, rtol=1e-10)


class Plain:
    """An object of the user's, as no library knows it."""

    def __init__(self, theta, scale):
        self.theta, self.scale = theta, scale

    def dynamics(self, x, u, t):
        return pendulum(x, self._push(u), self.theta)

    def _push(self, u):
        return self.scale * u

    def __call__(self, x, u, t):
        return self.dynamics(x, u, t)


def ways(theta):
    """Yield functions that reach theta by every way that Python has."""
    table, space = {"theta": theta}, types.SimpleNamespace(theta=[theta])
    module = types.ModuleType("settings")
    module.theta = theta  # pyright: ignore[reportAttributeAccessIssue]

    def default(x, u, t, theta=theta):
        return pendulum(x, u, theta)

    def named(theta, x, u, t):
        return pendulum(x, u, theta)

    def recursive(x, u, t, depth=2):
        return recursive(x, u, t, depth - 1) if depth else pendulum(x, u, theta)

    @jax.jit
    def inner(x):
        return theta[0] * x

    class Network(eqx.Module):
        theta: jax.Array
        activation: object = jnp.tanh

        def __call__(self, x, u, t):
            return pendulum(x, u, self.theta)

    return {
        "closure": lambda x, u, t: pendulum(x, u, theta),
        "dictionary": lambda x, u, t: pendulum(x, u, table["theta"]),
        "namespace": lambda x, u, t: pendulum(x, u, space.theta[0]),
        "module": lambda x, u, t: pendulum(x, u, module.theta),
        "default": default,
        "partial": functools.partial(named, theta),
        "method": Plain(theta, 1.0).dynamics,
        "object": Plain(theta, 1.0),
        "recursion": recursive,
        "jit": jax.jit(lambda x, u, t: pendulum(x, u, theta)),
        "inner jit": lambda x, u, t: pendulum(x, u, inner(theta / theta[0])),
        "checkpoint": jax.checkpoint(lambda x, u, t: pendulum(x, u, theta)),
        "equinox": Network(theta),
    }


@pytest.mark.parametrize("way", ways(THETA))
def test_every_way_to_reach_a_number_is_followed(way):
    def value(theta):
        return jnp.sum(jnp.stack(jax.tree.leaves(Function(ways(theta)[way]))))

    plant = lambda theta: jc.FunctionPlant(ways(theta)[way], nx=2, nu=1)  # noqa: E731
    u = jnp.array([0.3])
    want = jax.jacfwd(lambda theta: pendulum(X0, u, theta))(THETA)
    # Through a boundary that only leaves pass, as in a solve.
    leaves, structure = jax.tree.flatten(plant(THETA))
    assert [leaf.shape for leaf in leaves].count((3,)) == 1

    def moved(theta):
        put = [theta if np.shape(leaf) == (3,) else leaf for leaf in leaves]
        return jax.tree.unflatten(structure, put)(X0, u, 0.0)

    np.testing.assert_allclose(jax.jacfwd(moved)(THETA), want, rtol=1e-12)
    np.testing.assert_array_equal(plant(THETA)(X0, u, 0.0), pendulum(X0, u, THETA))


def test_a_changed_global_is_seen_by_the_next_solve(monkeypatch):
    dynamics = lambda x, u, t: jnp.array([x[1], u[0] - helper(x[0])])  # noqa: E731
    costs = []
    for value in (2.0, 0.5, 2.0):
        monkeypatch.setitem(globals(), "gain", value)
        costs.append(float(solve(dynamics).cost))
    assert costs[0] == costs[2] and abs(costs[0] - costs[1]) > 1e-2
    monkeypatch.setitem(globals(), "gain", 0.5)
    fresh = solve(lambda x, u, t: jnp.array([x[1], u[0] - 0.5 * x[0]]))
    np.testing.assert_allclose(costs[1], fresh.cost, rtol=1e-12)


def test_a_changed_object_is_seen_by_the_next_solve():
    thing = Plain(THETA, 1.0)
    problem = jc.Problem(
        jc.FunctionPlant(thing.dynamics, nx=2, nu=1), jc.QuadraticCost(Q=1.0, R=0.1), **STEPS
    )
    first = jc.solve(problem, jc.ILQR(), X0).cost
    thing.scale, thing.theta = 3.0, 2 * THETA
    second = jc.solve(problem, jc.ILQR(), X0).cost
    plant = jc.FunctionPlant(lambda x, u, t: pendulum(x, 3.0 * u, 2 * THETA), nx=2, nu=1)
    other = eqx.tree_at(lambda p: p.plant, problem, plant)
    np.testing.assert_allclose(second, jc.solve(other, jc.ILQR(), X0).cost, rtol=1e-12)
    assert abs(first - second) > 1e-3


def test_a_plant_follows_its_function_after_the_problem_was_edited_elsewhere():
    scale = {"value": 1.0}
    plant = jc.FunctionPlant(lambda x, u, t: scale["value"] * x, nx=2, nu=1)
    problem = jc.Problem(plant, jc.QuadraticCost(Q=1.0), **STEPS) + jc.QuadraticCost(R=1.0)
    problem = eqx.tree_at(lambda p: p.dt, problem, jnp.asarray(0.05))
    scale["value"] = 4.0
    np.testing.assert_allclose(problem.plant(X0, jnp.zeros(1), 0.0), 4 * X0)


def test_functions_made_anew_and_arrays_changed_trace_once():
    traces = []

    def make(theta, number):
        def dynamics(x, u, t):
            traces.append(1)
            return number * pendulum(x, u, theta)

        return dynamics

    first = solve(make(THETA, 1.0)).cost
    count = len(traces)
    second = solve(make(2 * THETA, 1.0)).cost
    assert len(traces) == count and first != second
    solve(make(THETA, 1.5))  # a Python number is static
    assert len(traces) > count


def test_numpy_constants_stay_numpy_and_are_compared_by_value():
    A = np.array([[0.0, 1.0], [-1.0, -0.1]])
    steps = {1: 2}
    dynamics = lambda x, u, t: np.linalg.matrix_power(A, steps[1]) @ x + u  # noqa: E731
    first = solve(dynamics).cost
    A[1, 0] = -3.0
    assert abs(solve(dynamics).cost - first) > 1e-3
    index = jnp.array([1, 0])
    swapped = Function(lambda x: x[index])
    assert jax.tree.leaves(swapped)[0].dtype == index.dtype
    np.testing.assert_array_equal(swapped(X0), X0[::-1])


def test_a_function_that_counts_its_calls_keeps_counting():
    calls = 0

    def dynamics(x, u, t):
        nonlocal calls
        calls += 1
        return pendulum(x, u, THETA)

    solve(dynamics)
    count = calls
    assert count > 0
    solve(dynamics)
    assert calls == count


def test_keys_do_not_disturb():
    key = jax.random.key(0)
    cost = solve(lambda x, u, t: -x + u + jax.random.normal(key, (2,))).cost
    noise = jax.random.normal(key, (2,))
    np.testing.assert_allclose(cost, solve(lambda x, u, t: -x + u + noise).cost, rtol=1e-12)


@pytest.mark.parametrize(
    ("where", "solver", "rtol"),
    [
        ("function", jc.DDP(), 1e-6),
        ("closure", jc.DDP(), 1e-6),
        ("params", jc.DDP(), 1e-6),
        ("cost", jc.DDP(), 1e-6),
        ("function", jc.ILQR(), 2e-5),  # as loose as its solution
    ],
)
def test_networks_work_as_they_are_with_gradients_by_their_weights(where, solver, rtol):
    def network(scale):
        net = eqx.nn.MLP(3, 2, 4, 1, activation=jnp.tanh, key=jax.random.key(1))
        return eqx.tree_at(lambda n: n.layers[0].weight, net, scale * net.layers[0].weight)

    class OfStateAndControl(eqx.Module):
        net: eqx.nn.MLP

        def __call__(self, x, u, t):
            return self.net(jnp.append(x, u))

    def cost(scale):
        net = network(scale)
        dynamics, running, params, weights = pendulum_0, None, None, None
        if where == "function":
            dynamics = OfStateAndControl(net)
        elif where == "closure":
            dynamics = lambda x, u, t: net(jnp.append(x, u))  # noqa: E731
        elif where == "params":
            dynamics, params = lambda x, u, t, p: p["net"](jnp.append(x, u)), {"net": net}
        else:
            running = lambda x, u, t: jnp.sum(net(jnp.append(x, u)) ** 2) + u @ u  # noqa: E731
        return solve(dynamics, running, solver, params=params, weights=weights).cost

    value, slope = jax.jit(jax.value_and_grad(cost))(1.0)
    by_value = jax.jit(cost)
    difference = (by_value(1 + 1e-4) - by_value(1 - 1e-4)) / 2e-4
    assert jnp.isfinite(value) and abs(slope) > 1e-4
    np.testing.assert_allclose(slope, difference, rtol=rtol)


def pendulum_0(x, u, t):
    return pendulum(x, u, (1.0, 0.2))


def test_gradients_of_a_network_are_read_off_where_its_weights_are():
    net = eqx.nn.MLP(3, 2, 4, 1, activation=jnp.tanh, key=jax.random.key(1))
    dynamics = lambda x, u, t, net: net(jnp.append(x, u))  # noqa: E731
    plant = jc.FunctionPlant(dynamics, nx=2, nu=1, params=net)
    problem = jc.Problem(plant, jc.QuadraticCost(Q=1.0, R=0.1), **STEPS)
    grads = jax.grad(lambda problem: jc.solve(problem, jc.ILQR(), X0).cost)(problem)
    assert grads.plant.params.layers[0].weight.shape == net.layers[0].weight.shape
    assert jnp.abs(grads.plant.params.layers[0].weight).max() > 0


def test_params_keep_integers_and_refuse_text():
    params = {"i": np.array([1, 0]), "on": True, "k": 2, "none": None}
    kept = jc.FunctionPlant(lambda x, u, t, p: x, nx=2, nu=1, params=params).params
    assert kept["i"].dtype == np.int64 and kept["on"].dtype == bool and kept["none"] is None
    assert kept["k"].dtype == np.float64
    with pytest.raises(TypeError, match=r"params\['mode'\]: .*'fast'.*close over"):
        jc.FunctionPlant(lambda x, u, t, p: x, nx=2, nu=1, params={"mode": "fast"})


def test_an_index_in_params_selects_a_state():
    dynamics = lambda x, u, t, i: x[i] + u  # noqa: E731
    cost = solve(dynamics, params=np.array([1, 0])).cost
    np.testing.assert_allclose(cost, solve(lambda x, u, t: x[::-1] + u).cost, rtol=1e-12)


class Sliding(jc.AbstractPlant):
    """A plant whose methods name globals of this module."""

    nx: int = eqx.field(static=True, default=2)
    nu: int = eqx.field(static=True, default=1)
    discrete: bool = eqx.field(static=True, default=False)
    control_bounds: None = None
    nominal_control: jax.Array = eqx.field(default_factory=lambda: jnp.zeros(1))

    def __call__(self, x, u, t):
        return jnp.array([x[1], u[0] - helper(x[0])])


def test_a_global_that_a_class_of_the_users_names_is_seen_by_the_next_solve(monkeypatch):
    problem = jc.Problem(Sliding(), jc.QuadraticCost(Q=1.0, R=0.1), **STEPS)
    costs, ends, slopes, defects, first = [], [], [], [], None
    for value in (2.0, 0.5, 2.0):
        monkeypatch.setitem(globals(), "gain", value)
        solution = jc.solve(problem, jc.ILQR(), X0)
        costs.append(float(solution.cost))
        first = first or solution
        slopes.append(jc.expand(problem, first.xs, first.us).fx[0, 1, 0])
        defects.append(float(jc.audit(problem, first).defects.max()))
        ends.append(jc.simulate(problem, jc.OpenLoop(jnp.zeros((8, 1))), X0).xs[-1, 1])
    assert costs[0] == costs[2] and abs(costs[0] - costs[1]) > 1e-2
    assert ends[0] == ends[2] and abs(ends[0] - ends[1]) > 1e-2
    assert slopes[0] == slopes[2] and abs(slopes[0] - slopes[1]) > 1e-2
    assert max(defects[0], defects[2]) < 1e-14 and defects[1] > 1e-2


def test_a_traced_number_out_of_sight_is_refused():
    def loss(theta):
        class Inner(Sliding):
            def __call__(self, x, u, t):
                return pendulum(x, u, theta)

        problem = jc.Problem(Inner(), jc.QuadraticCost(Q=1.0, R=0.1), **STEPS)
        return jc.solve(problem, jc.ILQR(), X0).cost

    with pytest.raises(TypeError, match=r"^plant: Inner.* make it a field"):
        jax.grad(loss)(THETA)

    class Opaque(dict):
        """No pytree, and no plain object."""

    def hidden(theta):
        opaque = Opaque(theta=theta)
        return solve(lambda x, u, t: pendulum(x, u, opaque["theta"])).cost

    with pytest.raises(TypeError, match=r"^plant: FunctionPlant of .*lambda.*`params=`"):
        jax.grad(hidden)(THETA)


def test_numpy_functions_in_dynamics_are_told_to_be_jnp():
    with pytest.raises(jax.errors.TracerArrayConversionError) as caught:
        solve(lambda x, u, t: np.sin(x))
    assert any("use jnp" in note for note in caught.value.__notes__)


def test_a_changed_leaf_is_named_where_it_is_not_finite():
    bad = jnp.array(jnp.nan)
    with pytest.raises(ValueError, match=r"problem: plant\.dynamics\.bad is not finite"):
        solve(lambda x, u, t: bad * x)


def test_without_x64_functions_close_over_float32(float32):
    theta = jnp.array([1.0, 0.2, 1.5])
    solution = solve(lambda x, u, t: pendulum(x, u, theta), x0=jnp.array([1.0, 0.0]))
    assert solution.us.dtype == np.float32 and solution.status.ok


class Gained(eqx.Module):
    """A network of the user's own class, whose method names a global."""

    weight: jax.Array

    def dynamics(self, x, u, t):
        return self.weight * helper(x) + u


@pytest.mark.parametrize("way", ["method", "closure"])
def test_a_global_that_a_network_names_is_seen(monkeypatch, way):
    net = Gained(jnp.array(1.0))
    plant = jc.FunctionPlant(
        net.dynamics if way == "method" else lambda x, u, t: net.dynamics(x, u, t), nx=2, nu=1
    )
    problem = jc.Problem(plant, jc.QuadraticCost(Q=1.0, R=0.1), **STEPS)
    ends = []
    for value in (2.0, 0.5):
        monkeypatch.setitem(globals(), "gain", value)
        ends.append(jc.simulate(problem, jc.OpenLoop(jnp.zeros((8, 1))), X0).xs[-1, 0])
    np.testing.assert_allclose(ends, [1.2**8, 1.05**8], rtol=1e-12)


chosen = 0
offsets = [1.0, 1.0]


def test_what_is_only_named_beside_a_write_is_still_compared(monkeypatch):
    def spring(j):
        return lambda x: jnp.zeros(2).at[j].add(x[j])

    def spring_of_module(x):
        return jnp.zeros(2).at[chosen].add(x[chosen])

    def local(x):
        offsets = []
        offsets.append(x)
        return outer(offsets[0])

    def outer(x):
        return x + jnp.array(offsets)

    assert Function(spring(0)).tree_flatten()[1] != Function(spring(1)).tree_flatten()[1]
    before = [Function(f).tree_flatten()[1] for f in (spring_of_module, local)]
    monkeypatch.setitem(globals(), "chosen", 1)
    monkeypatch.setitem(globals(), "offsets", [2.0, 1.0])
    after = [Function(f).tree_flatten()[1] for f in (spring_of_module, local)]
    assert before[0] != after[0] and before[1] != after[1]
    running = lambda j: lambda x, u, t: u @ u + 5 * jnp.sum(spring(j)(x) ** 2)  # noqa: E731
    dynamics = lambda x, u, t: jnp.array([x[1] - x[0], u[0]])  # noqa: E731
    assert abs(solve(dynamics, running(0)).cost - solve(dynamics, running(1)).cost) > 1e-3


class Logging:
    """An object with a log and a counter."""

    def __init__(self):
        self.log, self.calls, self.gain = [], 0, 1.0

    def push(self, x):
        self.log.append(1)
        self.calls += 1
        return self.gain * x


def test_logs_and_counters_are_left_alone():
    logs, table, calls, thing = {"a": []}, {}, 0, Logging()

    def function(x):
        nonlocal calls
        calls += 1
        logs["a"].append(1)
        table[calls] = 1
        function.calls = calls  # pyright: ignore[reportFunctionMemberAccess]
        return x

    for f in (function, thing.push):
        f(X0)
        before = Function(f).tree_flatten()[1]
        f(X0)
        assert Function(f).tree_flatten()[1] == before
    assert len(logs["a"]) == len(table) == calls == thing.calls == 2
    before = Function(thing.push).tree_flatten()[1]
    thing.gain = 2.0
    assert Function(thing.push).tree_flatten()[1] != before


class Model:
    """An object whose methods are named like a list's."""

    def __init__(self, w):
        self.w = w

    def update(self, x):
        return self.w * x


def test_only_containers_of_pythons_own_are_logs():
    model, other, seen = Model(1.0), Model(1.0), Model(1.0)
    module = types.ModuleType("settings")
    module.__dict__.update(W=1.0, add=lambda x: x)

    def function(x):
        seen.w = 3.0
        return model.update(x) + other.w + module.add(x) * module.W  # pyright: ignore

    keys = [Function(function).tree_flatten()[1]]
    for thing, name in ((model, "w"), (other, "w"), (module, "W")):
        setattr(thing, name, 2.0)
        keys.append(Function(function).tree_flatten()[1])
    assert len(set(keys)) == 4
    seen.w = 4.0
    assert Function(function).tree_flatten()[1] == keys[-1]


def test_a_file_beside_the_package_is_the_users_whatever_its_name():
    package = Path(jc.__file__).parent
    for name in ("jaxctrl_study.py", "jaxctrl_thesis/arm.py", "my-site-packages/arm.py"):
        assert is_own(str(package.parent / name))
    assert is_own("queue.py") and is_own("<stdin>") and is_own("__main__")
    installed = (str(package / "arm.py"), functools.__file__, np.__file__, "queue", "builtins")
    assert not any(map(is_own, installed))


class Key(enum.Enum):
    """Keys without an order."""

    A = 1
    B = 2


class Dotted(dict):
    """A dictionary whose items are attributes too."""

    __getattr__ = dict.__getitem__


class Space(types.SimpleNamespace):
    """A namespace of the user's."""


def containers(w):
    """Yield containers that JAX does not know, with w in them."""
    return {
        "enumeration": {Key.A: w, Key.B: 2.0},
        "mixed keys": {"a": w, 1: 2.0},
        "within": [{"b": ({"a": w, 1: 2.0},)}],
        "dotted": Dotted(w=w),
        "namespace": types.SimpleNamespace(w=w),
        "arguments": argparse.Namespace(w=w),
        "own namespace": Space(w=[w]),
        "deque": collections.deque([w], maxlen=3),
        "proxy": types.MappingProxyType({"w": w}),
    }


@pytest.mark.parametrize("kind", containers(1.0))
def test_containers_that_jax_does_not_know_are_compared_by_value(kind):
    def static(w):
        thing = containers(w)[kind]
        return Function(lambda x: [x, thing]).tree_flatten()[1]

    for one, two in ((1.0, 2.0), ("a", "b"), (np.ones(2), np.zeros(2))):
        assert static(one) == static(one) and static(one) != static(two)


@pytest.mark.parametrize("kind", ("enumeration", "mixed keys", "within", "arguments"))
def test_arrays_in_dictionaries_without_an_order_are_leaves(kind):
    thing = containers(THETA)[kind]
    leaves, structure = jax.tree.flatten(Function(lambda: thing))
    assert leaves == [THETA]
    moved = jax.tree.unflatten(structure, [2 * THETA])()
    while not isinstance(moved, jax.Array):
        moved = moved if isinstance(moved, list | tuple | dict) else vars(moved)
        moved = next(iter(moved.values())) if isinstance(moved, dict) else moved[0]
    np.testing.assert_array_equal(moved, 2 * THETA)


class Priced(jc.AbstractRate):
    """A cost with a constant of its class."""

    prices = (1.0, 2.0)

    def rate(self, plant, at):
        prices: Any = self.prices
        while not isinstance(prices[0], float):
            prices = prices[0]
        return prices[0] * at.x @ at.x + prices[1] * at.u @ at.u


@pytest.mark.parametrize(
    "wrap",
    (tuple, list, np.array, lambda p: {0: p}, lambda p: ([p],), lambda p: Dotted({0: p})),
    ids=("tuple", "list", "array", "dictionary", "nested", "dotted"),
)
def test_a_changed_constant_of_a_class_is_seen_by_the_next_solve(monkeypatch, wrap):
    problem = jc.Problem(Sliding(), Priced(), **STEPS)
    rollout = jc.OpenLoop(jnp.zeros((8, 1)))
    costs = []
    for prices in ((1.0, 2.0), (9.0, 2.0)):
        monkeypatch.setattr(Priced, "prices", wrap(prices))
        costs.append(float(jc.simulate(problem, rollout, X0).cost))
    np.testing.assert_allclose(costs[1], 9 * costs[0], rtol=1e-12)
