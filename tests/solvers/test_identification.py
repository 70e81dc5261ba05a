"""End to end: an arm's parameters from one of its optimal movements, by optax through solve."""

import jax
import jax.numpy as jnp
import numpy as np
import optax

import jaxctrl as jc


def test_masses_and_friction_of_the_torque_arm_are_recovered():
    # The upper arm's mass enters by its moment of inertia about the shoulder alone.
    truth = {"m2": 1.3, "I1": 0.034, "friction": 1.4}
    guess = {"m2": 1.0, "I1": 0.025, "friction": 1.0}
    x0 = jnp.array([0.8, 1.5, 0.0, 0.0])

    def solved(p):
        friction = p["friction"] * jnp.array([[0.05, 0.025], [0.025, 0.05]])
        arm = jc.plants.TorqueArm(m2=p["m2"], I1=p["I1"], friction=friction)
        problem = jc.tasks.posture(arm, jnp.array([1.3, 1.1]), 0.4, num_steps=40)
        return jc.solve(problem, jc.DDP(), x0)

    data = jax.jit(solved)(truth)

    def loss(logs):
        solution = solved(jax.tree.map(jnp.exp, logs))
        states = jnp.mean((solution.xs - data.xs) ** 2) / jnp.mean(data.xs**2)
        return states + jnp.mean((solution.us - data.us) ** 2) / jnp.mean(data.us**2)

    optimiser = optax.lbfgs()
    logs = jax.tree.map(jnp.log, jax.tree.map(jnp.asarray, guess))
    state = optimiser.init(logs)
    value_and_grad = optax.value_and_grad_from_state(loss)

    @jax.jit
    def step(logs, state):
        value, grad = value_and_grad(logs, state=state)
        updates, state = optimiser.update(grad, state, logs, value=value, grad=grad, value_fn=loss)
        return optax.apply_updates(logs, updates), state, value

    for _ in range(20):
        logs, state, _ = step(logs, state)
    found = jax.tree.map(lambda v: float(jnp.exp(v)), logs)
    for name, wanted in truth.items():
        np.testing.assert_allclose(found[name], wanted, rtol=1e-3)
