"""The cart-pole, the acrobot, the planar quadrotor and the car.

`tests/oracle/test_library.py` compares their dynamics with Lagrange's equations.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxctrl.plants import Acrobot, Car, CartPole, PlanarQuadrotor

PLANTS = {"cart-pole": CartPole, "acrobot": Acrobot, "quadrotor": PlanarQuadrotor, "car": Car}


def kinetic(plant, x):
    q, dq = x[: plant.num_joints], x[plant.num_joints :]
    return 0.5 * dq @ plant.mass_matrix(q) @ dq


def cart_pole_energy(plant, x):
    return kinetic(plant, x) + plant.m * plant.g * plant.hand(x)[1]


def acrobot_energy(plant, x):
    upper = plant.centre[0] * jnp.sin(x[0])
    lower = plant.l[0] * jnp.sin(x[0]) + plant.centre[1] * jnp.sin(x[0] + x[1])
    return kinetic(plant, x) + plant.g * (plant.m[0] * upper + plant.m[1] * lower)


@pytest.mark.parametrize(
    ("plant", "energy", "start"),
    [
        (CartPole(m=0.7, l=0.8), cart_pole_energy, [0.3, 2.0, -1.0, 3.0]),
        (Acrobot(centre=[0.4, 0.7], inertia=[0.1, 0.3], friction=0.0), acrobot_energy,
         [0.3, -1.1, 2.0, -3.0]),
    ],
    ids=["cart-pole", "acrobot"],
)  # fmt: skip
def test_energy_is_conserved_without_control_and_friction(rk4, plant, energy, start):
    xs = rk4(lambda x: plant(x, jnp.zeros(1), 0.0), jnp.array(start), 1e-3, 4000)
    energies = jax.vmap(lambda x: energy(plant, x))(xs)
    assert float(jnp.abs(xs).max()) > 3  # it moved
    np.testing.assert_allclose(energies, energies[0], rtol=1e-8)


def test_friction_takes_energy_from_the_acrobot(rk4):
    plant = Acrobot(friction=[0.3, 0.2])
    start = jnp.array([0.3, 0.5, 1.0, 0.0])
    xs = rk4(lambda x: plant(x, jnp.zeros(1), 0.0), start, 1e-3, 3000)
    assert (jnp.diff(jax.vmap(lambda x: acrobot_energy(plant, x))(xs)) < 0).all()


def test_the_cart_poles_momentum_along_the_rail_changes_by_the_force_alone():
    plant = CartPole()
    x, u = jnp.array([0.1, 2.2, 0.5, -3.0]), jnp.array([1.7])

    def momentum(x):
        return (plant.mass_matrix(x[:2]) @ x[2:])[0]

    np.testing.assert_allclose(jax.jvp(momentum, (x,), (plant(x, u, 0.0),))[1], u[0], rtol=1e-13)


@pytest.mark.parametrize("plant", [CartPole(), Acrobot()], ids=["cart-pole", "acrobot"])
def test_power_of_the_control_is_that_on_the_joints(plant):
    """dE/dt = tau'dq, less friction's B|dq|^2."""
    x, u = jnp.array([0.4, 2.2, 0.5, -3.0]), jnp.array([1.7])
    energy = cart_pole_energy if isinstance(plant, CartPole) else acrobot_energy
    power = jax.jvp(lambda x: energy(plant, x), (x,), (plant(x, u, 0.0),))[1]
    lost = 0.0 if isinstance(plant, CartPole) else jnp.sum(plant.friction * x[2:] ** 2)
    np.testing.assert_allclose(power, plant.joint_torque(x, u) @ x[2:] - lost, rtol=1e-12)


def test_a_hovering_quadrotor_stays_and_a_free_one_falls():
    plant = PlanarQuadrotor(m=1.3, l=0.4)
    x = plant.at_rest(np.array([2.0, 3.0]))
    np.testing.assert_allclose(plant(x, plant.nominal_control, 0.0), 0, atol=1e-15)
    falling = plant(plant.at_rest(np.array([2.0, 3.0]), 0.4), jnp.zeros(2), 0.0)
    np.testing.assert_allclose(falling, [0, 0, 0, 0, -9.81, 0], rtol=1e-14)


def test_a_tilted_quadrotor_goes_where_it_leans_and_the_rear_rotor_tilts_it_ahead():
    plant = PlanarQuadrotor()
    leaning = plant(plant.at_rest(np.zeros(2), 0.2), plant.nominal_control, 0.0)
    assert leaning[3] > 0 and leaning[4] < 0
    turning = plant(plant.at_rest(np.zeros(2)), plant.nominal_control + jnp.array([0.0, 0.1]), 0.0)
    np.testing.assert_allclose(turning[5], 0.1 * 0.15 / (0.2 * 0.3**2), rtol=1e-13)


def test_the_cars_axles_stay_apart_and_its_rear_one_rolls_straight_on():
    plant, rng = Car(d=1.7), np.random.default_rng(0)
    for _ in range(20):
        x, u = rng.normal(size=4) * [1, 1, 2, 10], rng.uniform(-0.6, 0.6, 2)
        after = plant(jnp.asarray(x), jnp.asarray(u), 0.0, 0.03)
        ahead = np.array([np.cos(x[2]), np.sin(x[2])])
        moved = np.asarray(after[:2]) - x[:2]
        np.testing.assert_allclose(moved @ [-ahead[1], ahead[0]], 0, atol=1e-14)
        front, new = (p[:2] + 1.7 * np.r_[np.cos(p[2]), np.sin(p[2])] for p in (x, after))
        roll = 0.03 * x[3] * np.r_[np.cos(x[2] + u[0]), np.sin(x[2] + u[0])]
        np.testing.assert_allclose(new - front, roll, atol=1e-14)
        np.testing.assert_allclose(after[3], x[3] + 0.03 * u[1], rtol=1e-15)


def test_a_car_turns_as_a_bicycle_does_in_the_limit_of_small_steps():
    plant = Car()
    x, u = jnp.array([0.0, 0.0, 0.3, 5.0]), jnp.array([0.4, 0.0])
    rate = (plant(x, u, 0.0, 1e-7) - x) / 1e-7
    forward = 5 * np.cos(0.4)
    want = [forward * np.cos(0.3), forward * np.sin(0.3), 5 * np.sin(0.4) / 2.0, 0]
    np.testing.assert_allclose(rate, want, rtol=1e-6, atol=1e-8)


def test_states_at_rest():
    np.testing.assert_array_equal(CartPole().at_rest(0.5, np.pi), [0.5, np.pi, 0, 0])
    np.testing.assert_array_equal(Acrobot().at_rest(-1.5), [-1.5, 0, 0, 0])
    np.testing.assert_array_equal(PlanarQuadrotor().at_rest(np.r_[1, 2], 0.1), [1, 2, 0.1, 0, 0, 0])
    np.testing.assert_array_equal(Car().at_rest(np.r_[1, 2], 0.1), [1, 2, 0.1, 0])
    for plant in (PlanarQuadrotor(), Car()):
        with pytest.raises(ValueError, match=r"^position: got shape \(3,\), wanted \(2,\)"):
            plant.at_rest(np.zeros(3), 0.0)
    with pytest.raises(ValueError, match=r"^angle:"):
        CartPole().at_rest(0.0, np.nan)


def test_hands():
    np.testing.assert_allclose(CartPole().hand(jnp.array([0.3, np.pi, 0, 0])), [0.3, 0.5])
    np.testing.assert_allclose(CartPole().hand_velocity(jnp.array([0, 0, 0, 2.0])), [1.0, 0])
    acrobot = Acrobot(l=[1.0, 2.0])
    hand = acrobot.hand(acrobot.at_rest(-np.pi / 2, np.pi / 2))
    np.testing.assert_allclose(hand, [2, -1], atol=1e-15)
    assert acrobot.longest_reach == 3 and np.isinf(CartPole().longest_reach)


@pytest.mark.parametrize(
    ("build", "name", "value"),
    [
        (CartPole, "M", 0.0), (CartPole, "m", -1.0), (CartPole, "l", [1.0, 2.0]),
        (CartPole, "g", np.nan), (Acrobot, "m", 0.0), (Acrobot, "l", np.ones(3)),
        (Acrobot, "centre", -1.0), (Acrobot, "inertia", -1.0), (Acrobot, "friction", [1.0, -1.0]),
        (PlanarQuadrotor, "m", 0.0), (PlanarQuadrotor, "inertia", 0.0), (Car, "d", 0.0),
    ],
)  # fmt: skip
def test_an_impossible_parameter_is_refused_by_name(build, name, value):
    with pytest.raises(ValueError, match=f"^{name}:"):
        build(**{name: value})


@pytest.mark.parametrize("name", PLANTS)
def test_without_x64_everything_is_float32(name, float32):
    plant = PLANTS[name](control_bounds=(-1.0, 1.0))
    assert {leaf.dtype for leaf in jax.tree.leaves(plant)} == {np.dtype("float32")}
    x = jnp.full(plant.nx, 0.3)
    given = (x, plant.nominal_control, 0.0) + (0.03,) * (name == "car")
    assert jax.eval_shape(plant, *given).dtype == jnp.float32
