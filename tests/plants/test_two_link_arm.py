import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jaxctrl.plants import TorqueArm

GRID = np.stack(np.meshgrid(np.linspace(-np.pi, np.pi, 25), np.linspace(-np.pi, np.pi, 25)), -1)
PARAMETERS = dict(m2=1.3, l1=0.28, l2=0.35, s2=0.14, I1=0.03, I2=0.05)


def lagrangian(q, dq, m2, l1, l2, s2, I1, I2):
    """Kinetic energy from the velocity of the forearm's centre of mass; l2 does not enter."""

    def centre(q):
        return jnp.array(
            [
                l1 * jnp.cos(q[0]) + s2 * jnp.cos(q[0] + q[1]),
                l1 * jnp.sin(q[0]) + s2 * jnp.sin(q[0] + q[1]),
            ]
        )

    _, v = jax.jvp(centre, (q,), (dq,))
    spin = (I2 - m2 * s2**2) * (dq[0] + dq[1]) ** 2
    return 0.5 * (m2 * v @ v + I1 * dq[0] ** 2 + spin)


def test_accelerations_are_those_of_the_lagrangian():
    arm = TorqueArm(**PARAMETERS)
    rng = np.random.default_rng(0)
    xs, us = rng.uniform(-2, 2, (50, 4)), rng.uniform(-1, 1, (50, 2))

    def want(x, u):
        q, dq = x[:2], x[2:]
        energy = lambda q, dq: lagrangian(q, dq, **PARAMETERS)  # noqa: E731
        M = jax.hessian(energy, 1)(q, dq)
        momentum_by_q = jax.jacfwd(jax.grad(energy, 1), 0)(q, dq)
        friction = jnp.array([[0.05, 0.025], [0.025, 0.05]]) @ dq
        force = u - friction - momentum_by_q @ dq + jax.grad(energy, 0)(q, dq)
        return jnp.concatenate([dq, jnp.linalg.solve(M, force)])

    got = jax.vmap(lambda x, u: arm(x, u, 0.0))(xs, us)
    np.testing.assert_allclose(got, jax.jit(jax.vmap(want))(xs, us), rtol=1e-11, atol=1e-12)


def test_mass_matrix_coriolis_and_acceleration_belong_together():
    arm = TorqueArm()
    x, u = jnp.array([0.4, 1.2, -0.9, 1.4]), jnp.array([0.3, -0.2])
    M, C = arm.mass_matrix(x[:2]), arm.coriolis(x[:2], x[2:])
    ddq = arm(x, u, 0.0)[2:]
    np.testing.assert_allclose(M @ ddq + C + arm.skeleton.friction @ x[2:], u, atol=1e-14)
    np.testing.assert_allclose(arm.kinetic_energy(x), 0.5 * x[2:] @ M @ x[2:], rtol=1e-14)


@pytest.mark.parametrize(("m2", "least"), [(1.1, 2.79216e-3), (1.0, 2.871e-3)])
def test_the_mass_matrix_is_positive_definite_everywhere(m2, least):
    M = jax.vmap(jax.vmap(TorqueArm(m2=m2).mass_matrix))(GRID)
    np.testing.assert_array_equal(M, np.swapaxes(M, -1, -2))
    assert np.linalg.eigvalsh(M).min() > 0
    np.testing.assert_allclose(np.linalg.det(M).min(), least, rtol=1e-12)


def test_without_friction_and_torque_the_kinetic_energy_stays(rk4):
    arm = TorqueArm(friction=np.zeros((2, 2)))
    xs = rk4(lambda x: arm(x, jnp.zeros(2), 0.0), jnp.array([0.3, 1.4, 1.0, -0.8]), 1e-3, 1000)
    energy = jax.vmap(arm.kinetic_energy)(xs)
    assert jnp.abs(energy / energy[0] - 1).max() < 1e-12


def test_friction_only_takes_energy(rk4):
    arm = TorqueArm()
    xs = rk4(lambda x: arm(x, jnp.zeros(2), 0.0), jnp.array([0.3, 1.4, 1.0, -0.8]), 1e-3, 1000)
    assert (jnp.diff(jax.vmap(arm.kinetic_energy)(xs)) < 0).all()


def test_a_driven_trajectory_equals_scipys(rk4):
    arm, u = TorqueArm(), np.array([0.4, -0.1])
    I1, I2, m2, l1, s2 = 0.025, 0.045, 1.1, 0.30, 0.16
    d1, d2, d3 = I1 + I2 + m2 * l1**2, m2 * l1 * s2, I2
    B = np.array([[0.05, 0.025], [0.025, 0.05]])

    def dynamics(_, x):
        c, s = d2 * np.cos(x[1]), d2 * np.sin(x[1])
        M = np.array([[d1 + 2 * c, d3 + c], [d3 + c, d3]])
        C = s * np.array([-x[3] * (2 * x[2] + x[3]), x[2] ** 2])
        return np.r_[x[2:], np.linalg.solve(M, u - C - B @ x[2:])]

    start = np.array([np.pi / 4, np.pi / 2, 0, 0])
    xs = rk4(lambda x: arm(x, u, 0.0), start, 1e-3, 500)
    want = solve_ivp(dynamics, (0, 0.5), start, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(xs[-1], want.y[:, -1], atol=1e-9)


def test_the_hand_at_the_standard_start_is_where_li_has_it():
    arm = TorqueArm()
    x = arm.at_rest(np.pi / 4, np.pi / 2)
    np.testing.assert_allclose(arm.hand(x), [-0.0212, 0.4455], atol=5e-5)
    np.testing.assert_array_equal(arm.hand_velocity(x), 0)


def test_the_hand_velocity_is_gamma_times_the_joint_rates():
    arm, x = TorqueArm(), jnp.array([0.4, 1.2, -0.9, 1.4])
    l1, l2, s1, c1 = 0.30, 0.33, np.sin(0.4), np.cos(0.4)
    s12, c12 = np.sin(1.6), np.cos(1.6)
    gamma = np.array([[-l1 * s1 - l2 * s12, -l2 * s12], [l1 * c1 + l2 * c12, l2 * c12]])
    np.testing.assert_allclose(arm.hand_velocity(x), gamma @ x[2:], rtol=1e-14)


def test_inverse_kinematics_undoes_the_hand():
    arm = TorqueArm()
    q = np.stack(np.meshgrid(np.linspace(-3.1, 3.1, 12), np.linspace(0.05, 3.1, 13)), -1)
    q = q.reshape(-1, 2)
    back = jax.jit(jax.vmap(lambda q: arm.inverse_kinematics(arm.hand_of_joints(q))))(q)
    np.testing.assert_allclose(back, q, atol=1e-12)


def test_a_straight_and_a_folded_arm_are_within_reach():
    arm = TorqueArm()
    shoulder, elbow = np.meshgrid(np.linspace(0, 1.5, 400), [0.0, np.pi])
    hands = jax.vmap(arm.hand_of_joints)(np.stack([shoulder.ravel(), elbow.ravel()], -1))
    back = jax.vmap(lambda e: arm.hand_of_joints(arm.inverse_kinematics(e)))(hands)
    np.testing.assert_allclose(back, hands, atol=1e-8)


def test_a_hand_out_of_reach_is_refused_or_nan():
    arm = TorqueArm()
    for hand in ([0.64, 0.0], [0.02, 0.0], [np.nan, 0.3]):
        with pytest.raises(ValueError, match="out of reach"):
            arm.inverse_kinematics(jnp.array(hand))
        assert jnp.isnan(jax.jit(lambda h: arm.inverse_kinematics(h))(jnp.array(hand))).any()
    with pytest.raises(ValueError, match="hand"):
        arm.inverse_kinematics(jnp.zeros(3))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((name, value) for name in PARAMETERS for value in (0, -1.0, np.nan, [1.0, 2.0])),
        ("I2", 0.01),
        ("friction", 0.05),
        ("friction", [0.05, 0.05]),
        ("friction", [[-0.1, 0.0], [0.0, 0.1]]),
        ("friction", [[0.01, 0.1], [0.1, 0.01]]),
    ],
)
def test_an_impossible_parameter_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=f"^{name}:"):
        TorqueArm(**{name: value})


def test_a_misspelt_parameter_is_refused():
    with pytest.raises(TypeError, match="mass2"):
        TorqueArm(mass2=1.0)


def test_angles_at_rest_must_be_finite_scalars():
    with pytest.raises(ValueError, match=r"^elbow:"):
        TorqueArm().at_rest(0.1, np.nan)
    with pytest.raises(ValueError, match=r"^shoulder:"):
        TorqueArm().at_rest([0.1, 0.2], 1.0)
