"""Structured Jacobians against plain ones, and the dependences against differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import PROBLEMS

import jaxctrl as jc
from jaxctrl._jacobian import dependence, jacobian

NAMES = [
    "discrete", "pendulum", "torque arm, reach", "torque arm, reach, RK4", "muscle arm, reach",
    "chain of 4",
]  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_jacobian_of_a_step_is_jaxs(name):
    problem, _ = PROBLEMS[name]()
    nx, nu = problem.plant.nx, problem.plant.nu

    def step(z, t):
        return problem.step(z[:nx], z[nx:], t)

    z = jax.random.uniform(jax.random.key(0), (nx + nu,), minval=0.1, maxval=0.9)
    got = jax.jit(jacobian(step))(z, 0.0)
    np.testing.assert_allclose(got, jax.jacfwd(step)(z, 0.0), rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("name", ["pendulum", "torque arm, reach", "muscle arm, reach"])
def test_hessian_contracted_with_costates_is_jaxs(name):
    problem, _ = PROBLEMS[name]()
    nx, nu = problem.plant.nx, problem.plant.nu
    z = jax.random.uniform(jax.random.key(1), (nx + nu,), minval=0.1, maxval=0.9)
    p = jax.random.normal(jax.random.key(2), (nx,))

    def value(z):
        return p @ problem.step(z[:nx], z[nx:], 0.0)

    got = jax.jit(jacobian(jax.grad(value), symmetric=True))(z)
    np.testing.assert_allclose(got, jax.hessian(value)(z), rtol=1e-9, atol=1e-12)


def test_muscle_arm_needs_two_reverse_passes_and_two_colours():
    problem, _ = PROBLEMS["muscle arm, reach"]()
    pattern = dependence(lambda z: problem.step(z[:10], z[10:], 0.0), jnp.zeros(16))
    wanted = np.zeros((10, 16), bool)
    wanted[:4, :4] = [[1, 0, 1, 0], [0, 1, 0, 1], [1, 1, 1, 1], [1, 1, 1, 1]]
    wanted[2:4, 4:10] = True
    wanted[4:, 4:10] = wanted[4:, 10:] = np.eye(6)
    np.testing.assert_array_equal(pattern, wanted)


def functions():
    A = np.array([[1.0, 2.0, 0.0], [0.0, 0.0, 3.0]])

    def looped(x):
        return jax.lax.fori_loop(0, 3, lambda i, c: c * x[0] + i, x[1:])

    def branched(x):
        return jax.lax.cond(x[0] > 0, lambda x: x[:2] ** 2, lambda x: x[1:], x)

    def moved(x):
        column = jnp.split(x.reshape(1, 3).T, [1])[1]
        joined = jnp.concatenate([x[::2], column.squeeze(1), x[None, :2].swapaxes(0, 1)[::-1, 0]])
        return joined * jnp.broadcast_to(x[1:2, None], (1, 6))[0]

    yield "product", lambda x: jnp.asarray(A) @ x
    yield "outer", lambda x: jnp.outer(x, x[:2]).ravel()
    yield "sorted", lambda x: jnp.sort(x)
    yield "summed by parts", lambda x: jnp.cumsum(x)
    yield "picked", lambda x: x[jnp.array([2, 0])] * jnp.stack([x[1], 1.0])
    yield "loop", looped
    yield "branch", branched
    yield "reversed", lambda x: jnp.flip(x).at[0].set(x[0])
    yield "moved", moved
    yield "constant", lambda x: jnp.ones(2)
    yield "reduced", lambda x: jnp.stack([x[:2].max(), jnp.prod(x), jnp.linalg.norm(x[1:])])
    yield "batched", lambda x: jnp.einsum("bij,bj->bi", x.reshape(1, 1, 3) * A[None], x[None])[0]
    yield "solved", lambda x: jc.linear.solve_positive(jnp.diag(x**2 + 1), x[:, None])[0][:, 0]


@pytest.mark.parametrize(("name", "function"), list(functions()))
def test_jacobian_is_right_whatever_the_operations(name, function):
    x = jnp.array([0.7, -0.4, 1.3])
    wanted = jax.jacfwd(function)(x)
    np.testing.assert_allclose(jacobian(function)(x), wanted, rtol=1e-12, atol=1e-14)
    pattern = dependence(function, x)
    assert not (np.asarray(wanted) != 0)[~pattern].any()


def test_a_stack_keeps_its_parts_apart_and_a_known_mask_its_zeros():
    mask = np.array([[True, False], [False, True], [False, False]])

    def function(x):
        return jnp.where(mask, jnp.outer(jnp.ones(3), x) * x[0], 0.0).reshape(-1)

    def stacked(x):
        return jnp.stack([x[1] ** 2, x[0]])

    x = jnp.array([0.3, 2.0])
    assert dependence(stacked, x).tolist() == [[False, True], [True, False]]
    pattern = dependence(function, x)
    assert pattern[0].tolist() == [True, False] and pattern[3].all()
    assert not pattern[[1, 2, 4, 5]].any()
    for f in (function, stacked):
        np.testing.assert_allclose(jacobian(f)(x), jax.jacfwd(f)(x), rtol=1e-12)


def test_a_rule_of_its_own_is_followed_through_what_the_function_stops():
    """A root by a fixed number of Newton steps, whose derivative is implicit."""

    @jax.custom_jvp
    def root(a):
        a = jax.lax.stop_gradient(a)
        y = jnp.ones_like(a)
        for _ in range(40):
            y = y - (y**3 + y - a) / (3 * y**2 + 1)
        return y

    @root.defjvp
    def _(primals, tangents):
        y = root(primals[0])
        return y, tangents[0] / (3 * y**2 + 1)

    @jax.custom_jvp
    def straight(a):
        return jnp.zeros_like(a)

    straight.defjvp(lambda primals, tangents: (straight(primals[0]), tangents[0]))
    x = jnp.array([0.3, 2.0])
    for function in (
        lambda x: jnp.stack([x[1], -root(x[0])]),
        lambda x: jnp.stack([straight(x[0]), x[1]]),
    ):
        np.testing.assert_allclose(jacobian(function)(x), jax.jacfwd(function)(x), rtol=1e-12)
        assert jacobian(function)(x).any(axis=1).all()
