import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxctrl.plants import (
    MUSCLES,
    OPTIMAL_LENGTH,
    MuscleArm,
    TorqueArm,
    activation_rate,
    endpoint_stiffness,
    force_length,
    isometric_torque,
    joint_stiffness,
    passive_force,
)

START = np.array([np.pi / 4, np.pi / 2])
ALPHA = np.array([[0, 0, 4.0, -4.2, 3.0, -3.9], [3.0, -1.9, 0, 0, 3.2, -2.2]]) / 100
BETA = np.array([[0, 0, -0.8, 0, -1.1, 0], [-1.1, 0, 0, 0, -1.0, 0]]) / 100
KATAYAMA = np.array([[0, 0, 4.0, -4.0, 2.8, -3.5], [2.5, -2.5, 0, 0, 2.8, -3.5]]) / 100


def postures(num=60, seed=0):
    return np.random.default_rng(seed).uniform(0, np.pi, (num, 2))


def test_there_are_six_muscles_in_the_published_order():
    assert MUSCLES == ("EF", "EX", "SF", "SX", "BF", "BX")
    arm = MuscleArm()
    assert (arm.nx, arm.nu, arm.num_joints, arm.discrete) == (10, 6, 2, False)
    np.testing.assert_array_equal(arm.control_bounds[0], np.zeros(6))
    np.testing.assert_array_equal(arm.control_bounds[1], np.ones(6))
    np.testing.assert_array_equal(arm.nominal_control, np.full(6, 0.05))


def test_peak_forces_are_31_8_newtons_per_square_centimetre():
    want = [572.4, 445.2, 699.6, 381.6, 159.0, 318.0]
    np.testing.assert_allclose(MuscleArm().peak_force, want, rtol=1e-14)


def test_kappa_from_the_length_ranges_is_that_of_van_wouwe_to_all_digits():
    want = [5.20634, 7.53892, 3.93810, 3.03152, 2.52278, 1.82637]
    paths = MuscleArm().paths
    np.testing.assert_allclose(1 / paths.optimal_length, want, atol=5e-6)
    np.testing.assert_allclose(paths.length_at_zero, [1.1, 0.8, 1.2, 0.7, 1.1, 0.85])


def test_moment_arms_are_those_of_the_table():
    q = postures()
    want = ALPHA + BETA * np.cos(1.9 * q)[:, :, None]
    np.testing.assert_allclose(jax.vmap(MuscleArm().moment_arms)(q), want, atol=1e-16)
    constant = jax.vmap(MuscleArm(arms="constant").moment_arms)(q)
    np.testing.assert_allclose(constant, np.broadcast_to(KATAYAMA, constant.shape), atol=1e-16)


@pytest.mark.parametrize("arms", ["cosine", "constant"])
def test_each_muscle_runs_through_its_range_of_lengths(arms):
    arm = MuscleArm(arms=arms)
    folded, straight = arm.muscle_length(jnp.full(2, jnp.pi)), arm.muscle_length(jnp.zeros(2))
    np.testing.assert_allclose(jnp.minimum(folded, straight), [0.6, 0.8, 0.7, 0.7, 0.6, 0.85])
    np.testing.assert_allclose(jnp.maximum(folded, straight), [1.1, 1.25, 1.2, 1.1, 1.1, 1.2])


@pytest.mark.parametrize("arms", ["cosine", "constant"])
def test_torques_are_the_tables_moment_arms_times_the_tensions(arms):
    arm, q = MuscleArm(arms=arms), postures()
    table = KATAYAMA if arms == "constant" else ALPHA + BETA * np.cos(1.9 * q)[:, :, None]
    tension = np.random.default_rng(2).uniform(0, 500, (len(q), 6))
    got = jax.vmap(arm.paths.torque)(q, tension)
    np.testing.assert_allclose(got, (table * tension[:, None]).sum(2), rtol=0, atol=1e-13)


def test_the_muscle_velocity_is_the_rate_of_the_length():
    arm, q, dq = MuscleArm(), postures(), postures(seed=1) - 1

    @jax.jit
    @jax.vmap
    def both(q, dq):
        return arm.muscle_velocity(q, dq), jax.jvp(arm.muscle_length, (q,), (dq,))[1]

    got, want = both(q, dq)
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-14)


def test_lengths_and_torques_at_the_standard_start():
    arm = MuscleArm(active_state="brown")
    np.testing.assert_allclose(
        arm.muscle_length(START), [0.859, 1.025, 1.093, 0.800, 0.930, 0.969], atol=5.1e-4
    )
    x = arm.at_rest(*START, activation=1.0)
    torques = arm.moment_arms(START) * arm.muscle_tension(x)
    np.testing.assert_allclose(torques[0], [0, 0, 17.0, -2.1, 1.7, -5.6], atol=0.051)
    np.testing.assert_allclose(torques[1], [5.4, -4.6, 0, 0, 2.5, -3.1], atol=0.051)
    np.testing.assert_allclose(arm.muscle_torque(x), torques.sum(1), rtol=1e-14)
    np.testing.assert_allclose(arm.hand(x), [-0.0212, 0.4455], atol=5e-5)


@pytest.mark.parametrize("curve", ["linear", "brown", "brown-fixed"])
def test_isometric_tension_at_full_activation_is_the_closed_form(curve):
    arm = MuscleArm(active_state=curve)
    x = arm.at_rest(*START, activation=1.0)
    l = np.asarray(arm.muscle_length(START))
    exponent = 2.11 + 4.16 * (1 / l - 1) * (curve == "brown")
    active = 1 - np.exp(-((1 / (0.56 * exponent)) ** exponent))
    active = 0.505 if curve == "linear" else active
    want = arm.peak_force * active * (force_length(l) + passive_force(l))
    np.testing.assert_allclose(arm.muscle_tension(x), want, rtol=1e-13)


def test_power_of_the_muscles_is_the_same_at_the_joints():
    """Tendons do not store energy: torque times joint rates is tension times shortening."""
    arm = MuscleArm()
    x = jnp.concatenate([START, jnp.array([0.7, -1.1]), jnp.linspace(0.1, 0.9, 6)])
    shortening = -arm.muscle_velocity(x[:2], x[2:4]) * arm.paths.optimal_length
    want = jnp.sum(arm.muscle_tension(x) * shortening)
    np.testing.assert_allclose(arm.muscle_torque(x) @ x[2:4], want, rtol=1e-13)


def test_the_dynamics_are_skeleton_and_activation():
    arm = MuscleArm(m2=1.0)
    x = jnp.concatenate([START, jnp.array([0.7, -1.1]), jnp.linspace(0.1, 0.9, 6)])
    u = jnp.array([0.5, 0.1, 0.9, 0.46, 0.0, 1.0])
    dx = arm(x, u, 0.0)
    np.testing.assert_array_equal(dx[:2], x[2:4])
    M, C = arm.mass_matrix(x[:2]), arm.coriolis(x[:2], x[2:4])
    balance = M @ dx[2:4] + C + arm.skeleton.friction @ x[2:4]
    np.testing.assert_allclose(balance, arm.muscle_torque(x), rtol=1e-13)
    np.testing.assert_allclose(dx[4:], activation_rate(x[4:], u), rtol=1e-14)


def test_each_muscle_accelerates_the_joints_it_spans_towards_its_own_side():
    arm = MuscleArm()
    for i, (shoulder, elbow) in enumerate([(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1)]):
        torque = arm.muscle_torque(arm.at_rest(*START, activation=0.5 * np.eye(6)[i]))
        np.testing.assert_array_equal(np.sign(np.round(torque, 9)), [shoulder, elbow])


def test_without_activation_the_arm_stays_at_rest():
    arm = MuscleArm()
    np.testing.assert_allclose(arm(arm.at_rest(*START), jnp.zeros(6), 0.0), 0, atol=1e-12)


def test_derivatives_are_finite_at_every_kink():
    """No activation, u = a, no velocity, and every muscle at its optimal length in turn."""
    arm = MuscleArm()

    @jax.jit
    def derivatives(arm, x):
        f = lambda z: arm(z[:10], z[10:], 0.0)  # noqa: E731
        z = jnp.concatenate([x, x[4:]])
        return jax.jacfwd(f)(z), jax.hessian(f)(z)

    for length in [0.0, *arm.muscle_length(START)]:
        # Moving its range of lengths brings one muscle to length 1 at this posture.
        shift = 1 - length if length else 0.0
        moved = MuscleArm(shortest=arm.paths.shortest + shift, longest=arm.paths.longest + shift)
        for activation in (0.0, 0.3):
            first, second = derivatives(moved, moved.at_rest(*START, activation=activation))
            assert jnp.isfinite(first).all() and jnp.isfinite(second).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("arms", "sine"),
        ("alpha", np.zeros((6, 2))),
        ("alpha", np.zeros((2, 6))),
        ("beta", np.zeros(6)),
        ("pcsa", np.zeros(6)),
        ("pcsa", np.ones(5)),
        ("specific_tension", -31.8),
        ("shortest", 0.0),
        ("longest", 0.5),
        ("activation_time", 0.0),
        ("deactivation_time", np.nan),
        ("arm_frequency", 0.0),
        ("nominal_control", np.ones(2)),
        ("control_bounds", (np.zeros(2), 1.0)),
        ("m2", -1.0),
    ],
)
def test_an_impossible_parameter_is_refused_by_name(name, value):
    kwargs = {"beta": 0.0} if name == "alpha" else {}
    with pytest.raises(ValueError, match=f"^{name}:"):
        MuscleArm(**{name: value}, **kwargs)


def test_a_state_at_rest_wants_six_activations_or_one():
    arm = MuscleArm()
    assert arm.at_rest(0.1, 0.2, activation=np.ones(6)).shape == (10,)
    for activation in (np.ones(5), -0.1, np.nan):
        with pytest.raises(ValueError, match=r"^activation:"):
            arm.at_rest(0.1, 0.2, activation=activation)


def test_every_physical_parameter_is_an_argument_and_a_leaf():
    arm, names = MuscleArm(), set(inspect.signature(MuscleArm.__init__).parameters)
    leaves = dict.fromkeys(("alpha", "beta", "arm_frequency", "shortest", "longest"), arm.paths)
    leaves |= dict.fromkeys(("pcsa", "specific_tension"), arm.muscles)
    leaves |= dict.fromkeys(("activation_time", "deactivation_time"), arm.muscles)
    assert set(leaves) <= names
    assert all(isinstance(getattr(part, name), jax.Array) for name, part in leaves.items())
    assert isinstance(arm.skeleton.m2, jax.Array)  # README


def test_another_word_for_the_active_state_is_refused():
    with pytest.raises(ValueError, match=r"active_state: .*'linear', 'brown', 'brown-fixed'"):
        MuscleArm(active_state="hill")


def test_a_given_optimal_length_keeps_arms_and_the_middle_of_the_range():
    arm, plain = MuscleArm(optimal_length=OPTIMAL_LENGTH), MuscleArm()
    np.testing.assert_allclose(arm.paths.optimal_length, OPTIMAL_LENGTH)
    q = postures()
    np.testing.assert_allclose(*(jax.vmap(a.moment_arms)(q) for a in (arm, plain)), atol=1e-15)
    ends = [[a.muscle_length(jnp.full(2, q)) for q in (0.0, jnp.pi)] for a in (arm, plain)]
    np.testing.assert_allclose(np.mean(ends[0], axis=0), np.mean(ends[1], axis=0), rtol=1e-13)
    width = np.abs(ends[0][1] - ends[0][0])
    np.testing.assert_allclose(width, np.abs(plain.paths.excursion) / OPTIMAL_LENGTH, rtol=1e-13)
    same = MuscleArm(optimal_length=plain.paths.optimal_length)
    np.testing.assert_allclose(*(jax.vmap(a.muscle_length)(q) for a in (same, plain)), rtol=1e-13)
    with pytest.raises(ValueError, match="optimal_length"):
        MuscleArm(optimal_length=-0.1)


def test_optimal_lengths_of_the_groups_are_means_weighted_by_force():
    """Holzbaur, Murray & Delp (2005), table 2: lengths [cm] and peak forces [N]."""
    groups = [
        [(13.2, 435.6), (8.6, 987.3), (17.3, 261.3)],
        [(11.4, 624.3), (2.7, 350.0)],
        [(9.8, 1142.6), (9.3, 242.5), (14.4, 364.4)],
        [(13.7, 259.9)],
        [(11.6, 624.3)],
        [(13.4, 798.5)],
    ]
    want = [np.average([l for l, _ in group], weights=[f for _, f in group]) for group in groups]
    np.testing.assert_allclose(OPTIMAL_LENGTH, np.array(want) / 100, atol=5.1e-4)


@pytest.mark.parametrize("curve", ["linear", "brown"])
def test_isometric_torques_are_those_of_the_state_at_rest(curve):
    arm, a = MuscleArm(active_state=curve), jnp.linspace(0.1, 0.9, 6)
    for q in postures(3):
        want = arm.muscle_torque(jnp.concatenate([q, jnp.zeros(2), a]))
        np.testing.assert_allclose(isometric_torque(arm, q, a), want, rtol=1e-13)
    with pytest.raises(ValueError, match="activation: shape"):
        isometric_torque(arm, START, np.ones(5))
    with pytest.raises(ValueError, match="q: shape"):
        isometric_torque(arm, np.ones(3), 0.1)
    for call in (isometric_torque, joint_stiffness, endpoint_stiffness):
        with pytest.raises(ValueError, match="activation: 0 to 1"):
            call(arm, START, -0.1)
        with pytest.raises(ValueError, match=r"q: shape \(\), wanted \(2,\)"):
            call(arm, 0.7, 0.1)
        with pytest.raises(TypeError, match="arm: an arm moved by muscles"):
            call(TorqueArm(), START, 0.1)
        with pytest.raises(ValueError, match="activation: 0 to 1"):
            call(arm, START, 30)
        with pytest.raises(ValueError, match="radians"):
            call(arm, np.array([45.0, 90.0]), 0.1)
        with pytest.raises(ValueError, match=r"q: .*finite"):
            call(arm, np.array([np.nan, 1.0]), 0.1)
        with pytest.raises(ValueError, match=r"q: .*0\.56 to 1\.9"):
            call(MuscleArm(optimal_length=OPTIMAL_LENGTH), np.array([np.pi, np.pi]), 0.3)


@pytest.mark.parametrize("curve", ["linear", "brown"])
def test_stiffness_is_what_a_small_displacement_meets(curve):
    """Joints: differences of the torque. Hand: the statics of a small load, solved by SciPy."""
    from scipy.optimize import fsolve

    arm, a = MuscleArm(active_state=curve), jnp.array([0.5, 0.2, 0.3, 0.7, 0.1, 0.4])
    skeleton = arm.skeleton
    torque = jax.jit(lambda q: isometric_torque(arm, q, a))
    hand = jax.jit(lambda q: skeleton.hand(q))
    jacobian = jax.jit(lambda q: jax.jacfwd(skeleton.hand)(q))
    for q in ([0.6, 1.3], [1.2, 0.9]):
        q, h = np.array(q), 1e-5
        K = joint_stiffness(arm, q, a)
        np.testing.assert_allclose(K, K.T, rtol=1e-12, atol=1e-12)
        for j, step in enumerate(h * np.eye(2)):
            column = -(torque(q + step) - torque(q - step)) / (2 * h)
            np.testing.assert_allclose(K[:, j], column, rtol=1e-7, atol=1e-7)
        held = -np.linalg.solve(np.asarray(jacobian(q)).T, np.asarray(torque(q)))
        K = endpoint_stiffness(arm, q, a)
        np.testing.assert_allclose(K, K.T, rtol=1e-10)
        for load in 1e-4 * np.eye(2):

            def unbalanced(at, force=held + load):
                return np.asarray(torque(at)) + np.asarray(jacobian(at)).T @ force

            moved = hand(fsolve(unbalanced, q, xtol=1e-10)) - hand(q)
            np.testing.assert_allclose(K @ moved, load, rtol=0, atol=1e-3 * 1e-4)
