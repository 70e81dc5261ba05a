"""A plant of MuJoCo's MJX, whose constraint solver is a while loop: an extra, `.[mjx]`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc

mujoco = pytest.importorskip("mujoco")
mjx = pytest.importorskip("mujoco.mjx")

# A gear between cart and pole: a constraint that yields a little, on which MJX iterates.
CART_POLE = """
<mujoco>
  <option timestep="0.02" iterations="20" tolerance="1e-12"/>
  <worldbody>
    <body>
      <joint name="slide" type="slide" axis="1 0 0" damping="0.1"/>
      <geom type="box" size="0.1 0.05 0.05" mass="1"/>
      <body>
        <joint name="hinge" type="hinge" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.2"/>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="slide" joint2="hinge" polycoef="0 0.3 0 0 0"/></equality>
  <actuator><motor joint="slide" gear="1"/></actuator>
</mujoco>
"""
X0 = jnp.zeros(4)
T = 25


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(CART_POLE)


@pytest.fixture(scope="module")
def problem(model):
    there = mjx.put_model(model)
    data = mjx.make_data(there)

    def dynamics(x, u, t):
        after = mjx.step(there, data.replace(qpos=x[:2], qvel=x[2:], ctrl=u))
        return jnp.concatenate([after.qpos, after.qvel])

    plant = jc.FunctionPlant(dynamics, nx=4, nu=1, discrete=True)
    cost = jc.FunctionCost(
        running=lambda x, u, t: 1e-3 * u @ u,
        terminal=lambda x: 10 * (x[1] - 0.8) ** 2 + 0.1 * x @ x,
    )
    return jc.Problem(plant, cost, num_steps=T, control_bounds=(-20.0, 20.0))


@pytest.fixture(scope="module")
def solution(problem):
    return jc.solve(problem, jc.ILQR(), X0)


def test_mujoco_itself_follows_the_states_of_the_solution(model, solution):
    assert solution.status.ok
    data = mujoco.MjData(model)
    data.qpos, data.qvel = np.split(np.asarray(X0), 2)
    for u, x in zip(solution.us, solution.xs[1:], strict=True):
        data.ctrl = np.asarray(u)
        mujoco.mj_step(model, data)
        np.testing.assert_allclose([*data.qpos, *data.qvel], x, atol=1e-6)
        assert data.nefc == 1


def test_no_other_control_costs_less(problem, solution):
    cost = jax.jit(lambda us: problem.total_cost(problem.rollout(X0, us), us))
    for key in range(20):
        change = 0.01 * jax.random.normal(jax.random.key(key), solution.us.shape)
        assert cost(jnp.clip(solution.us + change, -20, 20)) > solution.cost


@pytest.mark.slow  # second derivatives by forward mode: a minute of compiling
def test_forward_derivative_of_the_cost_is_a_difference(problem, solution):
    solve = jax.jit(lambda x: jc.solve(problem, jc.ILQR(), x, solution.us).cost)
    direction = jnp.array([0.0, 1.0, 0.5, -0.3])
    slope = jax.jit(lambda x: jax.jvp(solve, (x,), (direction,))[1])(X0)
    difference = (solve(X0 + 1e-5 * direction) - solve(X0 - 1e-5 * direction)) / 2e-5
    np.testing.assert_allclose(slope, difference, rtol=1e-4)


def test_reverse_mode_says_what_is_missing(problem):
    with pytest.raises(ValueError, match=r"through a lax.while_loop.*ILQR and DDP do without"):
        jc.solve(problem, jc.LBFGS(), X0)
