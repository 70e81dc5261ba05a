"""A body of one's own: a skeleton in space and paths of straight muscles, in the library's arm."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

import jaxctrl as jc
from jaxctrl import plants
from jaxctrl.plants import Channel, ConstantForce, Curl, InField, MuscleArm, MusculoskeletalArm


class SpatialArm(plants.AbstractSkeleton):
    """Azimuth, elevation and elbow, with point masses at elbow and hand, and gravity."""

    n: ClassVar[int] = 3
    dim: ClassVar[int] = 3
    m: Array = eqx.field(converter=jc.array_leaf, default=(1.5, 1.0))
    g: Array = eqx.field(converter=jc.array_leaf, default=0.0)
    friction: Array = eqx.field(converter=jc.array_leaf, default=0.1)

    def points(self, q):
        """Return elbow and hand (2, 3)."""
        around = jnp.stack([jnp.cos(q[0]), jnp.sin(q[0])])
        upper = jnp.append(jnp.cos(q[1]) * around, jnp.sin(q[1]))
        fore = jnp.append(jnp.cos(q[1] + q[2]) * around, jnp.sin(q[1] + q[2]))
        return jnp.stack([0.3 * upper, 0.3 * upper + 0.33 * fore])

    @property
    def longest_reach(self):
        return jnp.asarray(0.63)

    def mass_matrix(self, q):
        slopes = jax.jacfwd(self.points)(q)
        return jnp.einsum("p,pij,pik->jk", self.m, slopes, slopes) + 0.01 * jnp.eye(3)

    def potential(self, q):
        return self.g * jnp.sum(self.m * self.points(q)[:, 2])

    def bias(self, q, dq):
        turning = jax.jvp(lambda q: self.mass_matrix(q) @ dq, (q,), (dq,))[1]
        lagrangian = lambda q: self.kinetic_energy(q, dq) - self.potential(q)  # noqa: E731
        return turning - jax.grad(lagrangian)(q) + self.friction * dq

    def solve(self, q, torque):
        return jnp.linalg.solve(self.mass_matrix(q), torque)

    def hand(self, q):
        return self.points(q)[1]


class StraightPaths(plants.AbstractPaths):
    """Muscles from points of the trunk to the middle of the upper arm, and to the forearm."""

    n: ClassVar[int] = 3
    m: ClassVar[int] = 6
    skeleton: SpatialArm
    origins: Array = eqx.field(converter=jc.array_leaf)

    @property
    def optimal_length(self):
        return self.lengths(jnp.full(3, 0.6)) / 0.95

    def lengths(self, q):
        elbow, hand = self.skeleton.points(q)
        ends = jnp.stack([0.5 * elbow] * 4 + [elbow + 0.2 * (hand - elbow)] * 2)
        return jnp.sqrt(jnp.sum((ends - self.origins) ** 2, axis=1))


ORIGINS = 0.05 * np.array(
    [[0, 1, 1], [0, 1, -1], [0, -1, 1], [0, -1, -1], [1, 0, 1.5], [1, 0, -1.5]]
)
Q, DQ = jnp.array([0.5, 0.4, 0.9]), jnp.array([0.7, -1.1, 0.4])


@pytest.fixture(scope="module")
def arm():
    skeleton = SpatialArm()
    paths = StraightPaths(skeleton, ORIGINS)
    return MusculoskeletalArm(skeleton, paths, plants.Muscles(np.full(6, 20.0)))


def test_sizes_are_those_of_the_parts(arm):
    assert (arm.nx, arm.nu, arm.num_joints, arm.dim) == (12, 6, 3, 3)
    x = arm.at_rest([0.1, 0.2, 0.3], activation=0.5)
    np.testing.assert_array_equal(x, [0.1, 0.2, 0.3, 0, 0, 0] + [0.5] * 6)
    assert arm.hand(x).shape == arm.hand_velocity(x).shape == (3,)
    assert arm.moment_arms(Q).shape == (3, 6)


def test_moment_arms_are_minus_the_slope_and_torques_their_product_with_the_tensions(arm):
    h, lengths = 1e-6, arm.paths.lengths
    slopes = np.array([(lengths(Q + h * e) - lengths(Q - h * e)) / (2 * h) for e in np.eye(3)])
    arms = arm.moment_arms(Q)
    np.testing.assert_allclose(arms, -slopes, atol=1e-9)
    tension = np.linspace(10, 60, 6)
    np.testing.assert_allclose(arm.paths.torque(Q, tension), arms @ tension, rtol=1e-13)
    np.testing.assert_allclose(arm.paths.velocities(Q, DQ), -arms.T @ DQ, rtol=1e-13)


def test_muscles_put_the_power_into_the_skeleton_that_they_lose_by_shortening(arm):
    skeleton = SpatialArm(g=9.81)
    arm = eqx.tree_at(lambda a: a.skeleton, arm, skeleton)
    x = jnp.concatenate([Q, DQ, jnp.linspace(0.1, 0.6, 6)])

    def energy(x):
        return skeleton.kinetic_energy(x[:3], x[3:6]) + skeleton.potential(x[:3])

    rate = jax.jit(lambda arm: arm(x, jnp.full(6, 0.3), 0.0))(arm)
    power = jax.jit(lambda rate: jax.jvp(energy, (x,), (rate,))[1])(rate)
    shortening = -jnp.sum(arm.muscle_tension(x) * arm.paths.velocities(Q, DQ))
    np.testing.assert_allclose(power, shortening - 0.1 * jnp.sum(DQ**2), rtol=1e-11)


def test_a_hand_in_space_reaches(arm):
    x0 = arm.at_rest([0.5, 0.1, 0.9])
    target = arm.hand(arm.at_rest([0.8, 0.3, 0.7]))
    problem = jc.tasks.reach(arm, target, 0.4, num_steps=20, effort=1e-6)
    solution = jc.solve(problem, jc.ILQR(), x0, max_steps=100)
    assert jnp.linalg.norm(arm.hand(x0) - target) > 0.1
    assert jnp.linalg.norm(arm.hand(solution.xs[-1]) - target) < 0.01
    assert ((solution.us >= 0) & (solution.us <= 1)).all()


def test_tasks_ask_for_points_of_the_hands_own_space(arm):
    for make in (
        lambda: jc.tasks.reach(arm, np.zeros(2)),
        lambda: jc.tasks.hit(arm, np.zeros(3), np.zeros(2)),
        lambda: jc.tasks.obstacle(arm, np.full(3, 0.1), np.zeros(2)),
        lambda: jc.tasks.via(arm, np.full(3, 0.1), np.zeros((1, 2)), [0.1]),
        lambda: jc.tasks.track(arm, np.zeros((5, 2)), 0.5),
        lambda: jc.tasks.reach(MuscleArm(), np.zeros(3)),
    ):
        with pytest.raises(ValueError, match=r"^(target|velocity|centre|points|path): got shape"):
            make()
    jc.tasks.obstacle(arm, np.full(3, 0.1), np.full(3, 0.2))
    jc.tasks.via(arm, np.full(3, 0.1), np.zeros((1, 3)), [0.1])
    jc.tasks.track(arm, np.zeros((5, 3)), 0.5)
    with pytest.raises(ValueError, match=r"^plant: a hand in the plane is wanted, got one in 3"):
        jc.tasks.centre_out(arm, arm.at_rest(Q))


def test_a_plot_in_the_plane_refuses_paths_in_space():
    pytest.importorskip("matplotlib")
    with pytest.raises(ValueError, match=r"paths: shape \(9, 3\) given, wanted"):
        jc.plot.hand_paths(np.zeros((9, 3)))


def test_fields_push_in_space(arm):
    force, x = np.array([1.0, -2.0, 3.0]), arm.at_rest(Q, activation=0.2)
    u = jnp.full(6, 0.2)
    pushed = InField(arm, ConstantForce(force))
    slopes = jax.jacfwd(arm.hand_of_joints)(Q)
    gained = (pushed(x, u, 0.0) - arm(x, u, 0.0))[3:6]
    np.testing.assert_allclose(arm.mass_matrix(Q) @ gained, slopes.T @ force, rtol=1e-10)
    assert pushed.dim == 3
    with pytest.raises(ValueError, match=r"^field: a force of shape \(2,\), wanted \(3,\)"):
        InField(arm, Curl())
    channel = Channel(np.zeros(3), [0.0, 0.0, 1.0], stiffness=100.0, damping=10.0)
    force = channel(np.array([0.1, 0.2, 0.7]), np.array([1.0, 0.0, 5.0]), 0.0)
    np.testing.assert_allclose(force, [-20, -20, 0], atol=1e-13)


def test_the_muscle_arm_is_a_skeleton_with_paths_and_muscles():
    whole = MuscleArm(pcsa=12.0)
    parts = MusculoskeletalArm(whole.skeleton, whole.paths, whole.muscles)
    x, u = jnp.linspace(0.3, 0.8, 10), jnp.linspace(0.1, 0.9, 6)
    np.testing.assert_array_equal(parts(x, u, 0.0), whole(x, u, 0.0))
    np.testing.assert_array_equal(parts.nominal_control, whole.nominal_control)


def test_parts_that_do_not_fit_are_refused(arm):
    with pytest.raises(ValueError, match=r"^paths: 6 muscles over 3 joints, wanted 6 over 2"):
        MusculoskeletalArm(MuscleArm().skeleton, arm.paths, arm.muscles)
    with pytest.raises(ValueError, match=r"^pcsa: shape \(\), wanted \(m,\)"):
        plants.Muscles(20.0)
    with pytest.raises(ValueError, match=r"^alpha: shape \(6,\), wanted \(n, m\)"):
        plants.CosinePaths(np.ones(6), 0.0, arm_frequency=1.9, shortest=0.6, longest=1.1)


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("angle", lambda: plants.Pendulum().at_rest(180.0)),
        ("angle", lambda: plants.CartPole().at_rest(0.0, -180)),
        ("shoulder", lambda: plants.Acrobot().at_rest(90)),
        ("tilt", lambda: plants.PlanarQuadrotor().at_rest(np.zeros(2), 30.0)),
        ("elbow", lambda: plants.TorqueArm().at_rest(1.0, 90.0)),
        ("shoulder", lambda: MuscleArm().at_rest(45.0, 90.0)),
        ("q", lambda: plants.Chain(3).at_rest([0.1, 0.2, 20.0])),
    ],
)
def test_angles_that_can_only_be_degrees_are_questioned(name, make):
    with pytest.raises(ValueError, match=rf"^{name}: .* are these radians\?"):
        make()


def test_two_turns_and_a_cart_far_away_are_accepted():
    plants.Pendulum().at_rest(4 * np.pi)
    plants.CartPole().at_rest(100.0, np.pi)
    jax.jit(lambda angle: plants.Pendulum().at_rest(angle))(180.0)  # not known
