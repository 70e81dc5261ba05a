"""Arms moved by their torques' rates, and a hand moved by its jerk."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxctrl as jc
from jaxctrl.plants import Chain, FreeHand, MuscleArm, PolynomialJerk, RateControlled, TorqueArm


def rollout(plant, x0, us, dt=0.01, integrator=None):
    problem = jc.Problem(plant, jc.QuadraticCost(), num_steps=len(us), dt=dt, integrator=integrator)
    return jax.jit(lambda x0, us: problem.rollout(x0, us))(jnp.asarray(x0), jnp.asarray(us))


@pytest.mark.parametrize(
    ("arm", "integrator"),
    [(TorqueArm(), jc.Euler()), (TorqueArm(), jc.RK4()), (Chain(3), jc.Euler())],
    ids=["torque arm, Euler", "torque arm, RK4", "chain of 3, Euler"],
)
def test_constant_torques_move_it_as_they_move_the_arm(arm, integrator):
    plant = RateControlled(arm)
    x0, torque = (
        arm.at_rest(*([0.7, 1.2] if arm.nu == 2 else [0.4])),
        0.2 * np.arange(1, arm.nu + 1),
    )
    xs = rollout(plant, plant.lift(x0, torque), np.zeros((30, arm.nu)), integrator=integrator)
    wanted = rollout(arm, x0, np.tile(torque, (30, 1)), integrator=integrator)
    np.testing.assert_allclose(xs[:, : arm.nx], wanted, rtol=1e-12, atol=1e-14)
    np.testing.assert_array_equal(jax.vmap(plant.command)(xs), np.tile(torque, (31, 1)))


def test_torques_are_the_sum_of_their_rates():
    plant, rates = RateControlled(TorqueArm()), np.random.default_rng(0).normal(size=(20, 2))
    xs = rollout(plant, plant.lift(plant.inner.at_rest(0.7, 1.2), [0.3, -0.1]), rates)
    torques = np.array([0.3, -0.1]) + 0.01 * np.cumsum(rates, axis=0)
    np.testing.assert_allclose(xs[1:, 4:], torques, rtol=1e-12)
    for x, torque in zip(xs[1:], torques, strict=True):
        np.testing.assert_allclose(plant.joint_torque(x, np.zeros(2)), torque, rtol=1e-12)


def test_it_has_the_hand_and_the_inertia_of_its_arm():
    arm = TorqueArm()
    plant, x = RateControlled(arm), jnp.array([0.7, 1.2, -0.4, 0.9])
    lifted = plant.lift(x, 0.5)
    np.testing.assert_array_equal(lifted, jnp.concatenate([x, jnp.array([0.5, 0.5])]))
    assert (plant.nx, plant.nu, plant.num_joints) == (6, 2, 2) and plant.control_bounds is None
    np.testing.assert_allclose(plant.hand(lifted), arm.hand(x), rtol=1e-14)
    np.testing.assert_allclose(plant.hand_velocity(lifted), arm.hand_velocity(x), rtol=1e-14)
    np.testing.assert_array_equal(plant.mass_matrix(x[:2]), arm.mass_matrix(x[:2]))


@pytest.mark.parametrize(
    ("build", "error", "match"),
    [
        (lambda: RateControlled(MuscleArm()), ValueError, "^arm: its controls have bounds"),
        (
            lambda: RateControlled(TorqueArm(control_bounds=(-1.0, 1.0))),
            ValueError,
            "make it without control_bounds",
        ),
        (lambda: RateControlled(TorqueArm), TypeError, "^arm: a plant with joints is wanted"),
        (lambda: FreeHand().at_rest(0.3), ValueError, r"position: shape \(\), wanted \(2,\)"),
        (lambda: RateControlled(FreeHand()), TypeError, "wanted, got FreeHand"),
        (
            lambda: RateControlled(TorqueArm()).lift(jnp.zeros(6)),
            ValueError,
            r"^x: shape \(6,\), wanted \(\) or \(4,\)",
        ),
        (
            lambda: RateControlled(TorqueArm()).lift(jnp.zeros(4), [1.0, 2.0, 3.0]),
            ValueError,
            r"^command: shape \(3,\)",
        ),
        (
            lambda: RateControlled(TorqueArm()).lift(jnp.zeros(4), np.nan),
            ValueError,
            "^command: finite",
        ),
        (lambda: FreeHand().hand(jnp.zeros((5, 6))), ValueError, r"^x: got shape \(5, 6\).*vmap"),
        (lambda: FreeHand().hand_velocity(jnp.zeros(4)), ValueError, r"^x: got shape \(4,\)"),
        (lambda: FreeHand().at_rest([0.1, 0.2, 0.3]), ValueError, "^position: shape"),
        (lambda: FreeHand().at_rest([0.1, 0.2], np.nan), ValueError, "^velocity: finite"),
    ],
)
def test_misuse_is_named(build, error, match):
    with pytest.raises(error, match=match):
        build()


@pytest.mark.parametrize("seed", range(3))
def test_a_step_of_polynomial_jerk_is_the_integral_of_its_polynomial(seed):
    rng = np.random.default_rng(seed)
    x, u, dt = rng.normal(size=6), rng.normal(size=(3, 2)), rng.uniform(0.05, 0.4)
    got = PolynomialJerk()(FreeHand(), jnp.asarray(x), jnp.asarray(u.ravel()), 0.0, dt)
    series = np.polynomial.Polynomial
    for j in range(2):
        legendre = np.polynomial.Legendre(u[:, j], domain=[0, dt])  # on [0, dt], not [-1, 1]
        jerk = legendre.convert(kind=series, domain=[-1, 1], window=[-1, 1])
        acceleration = jerk.integ() + x[4 + j]
        velocity = acceleration.integ() + x[2 + j]
        position = velocity.integ() + x[j]
        wanted = [position(dt), velocity(dt), acceleration(dt)]
        np.testing.assert_allclose(got[j::2], wanted, rtol=1e-12, atol=1e-14)


def test_a_path_of_polynomial_jerk_equals_scipys():
    rng, dt = np.random.default_rng(5), 0.1
    us = rng.normal(size=(5, 6))
    xs = rollout(FreeHand(), np.zeros(6), us, dt, PolynomialJerk())

    def dynamics(t, x, u):
        s = t / dt
        jerk = u[:2] + u[2:4] * (2 * s - 1) + u[4:] * (6 * s**2 - 6 * s + 1)
        return np.r_[x[2:], jerk]

    x = np.zeros(6)
    for k, u in enumerate(us):
        x = solve_ivp(dynamics, (0, dt), x, args=(u,), rtol=1e-11, atol=1e-13).y[:, -1]
        np.testing.assert_allclose(xs[k + 1], x, atol=1e-11)


def test_runge_kutta_holds_the_mean_jerk_and_is_then_exact_too():
    us = np.random.default_rng(1).normal(size=(20, 6))
    us[:, 2:] = 0
    x0 = FreeHand().at_rest([0.1, 0.3], [0.2, -0.1])
    exact = rollout(FreeHand(), x0, us, 0.05, PolynomialJerk())
    np.testing.assert_allclose(rollout(FreeHand(), x0, us, 0.05, jc.RK4()), exact, atol=1e-13)


def test_a_free_hand_at_rest_moves_on_at_its_velocity():
    plant = FreeHand()
    x0 = plant.at_rest([0.1, 0.3], [0.2, -0.1])
    np.testing.assert_array_equal(x0, [0.1, 0.3, 0.2, -0.1, 0, 0])
    xs = rollout(plant, x0, np.zeros((10, 6)), 0.1, PolynomialJerk())
    np.testing.assert_allclose(plant.hand(xs[-1]), [0.3, 0.2], rtol=1e-14)
    np.testing.assert_allclose(plant.hand_velocity(xs[-1]), [0.2, -0.1], rtol=1e-14)


def test_float32_stays_float32(float32):
    arm, hand = RateControlled(TorqueArm()), FreeHand()
    assert arm.lift(arm.inner.at_rest(0.7, 1.2), 0.1).dtype == jnp.float32
    assert jax.eval_shape(arm, jnp.ones(6), jnp.ones(2), jnp.zeros(())).dtype == jnp.float32
    dt = jnp.array(0.1)
    step = jax.eval_shape(PolynomialJerk(), hand, hand.at_rest([0.1, 0.2]), jnp.ones(6), 0.0, dt)
    assert step.dtype == jnp.float32
