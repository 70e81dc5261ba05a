import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipk

from jaxctrl.plants import Pendulum


def test_the_dynamics_are_those_of_li_with_his_numbers():
    x, u = np.array([0.7, -1.3]), np.array([0.4])
    want = [x[1], 9.8 * np.sin(x[0]) - 0.01 * x[1] + u[0]]
    np.testing.assert_allclose(Pendulum()(x, u, 0.0), want, rtol=1e-15)


def test_mass_length_gravity_and_friction_enter_as_in_eq_4_22():
    m, l, g, mu = 1.7, 0.6, 3.1, 0.2
    x, u = np.array([2.7, 0.9]), np.array([-0.4])
    want = g / l * np.sin(x[0]) - mu / (m * l**2) * x[1] + u[0] / (m * l**2)
    got = Pendulum(m=m, l=l, g=g, friction=mu)(x, u, 0.0)
    np.testing.assert_allclose(got, [x[1], want], rtol=1e-14)


@pytest.mark.parametrize("amplitude", [0.1, 1.0, 2.5])
def test_the_period_without_friction_is_the_elliptic_integral(rk4, amplitude):
    plant = Pendulum(l=0.7, friction=0.0)
    period = 4 * np.sqrt(0.7 / 9.8) * ellipk(np.sin(amplitude / 2) ** 2)
    start = plant.at_rest(np.pi + amplitude)
    xs = rk4(lambda x: plant(x, jnp.zeros(1), 0.0), start, period / 4000, 4000)
    np.testing.assert_allclose(xs[-1], start, atol=1e-9)


def test_a_driven_trajectory_equals_scipys(rk4):
    plant = Pendulum()
    xs = rk4(lambda x: plant(x, jnp.array([1.5]), 0.0), plant.at_rest(np.pi), 1e-3, 2000)
    want = solve_ivp(
        lambda _, x: [x[1], 9.8 * np.sin(x[0]) - 0.01 * x[1] + 1.5],
        (0, 2),
        [np.pi, 0],
        rtol=1e-11,
        atol=1e-12,
    )
    np.testing.assert_allclose(xs[-1], want.y[:, -1], atol=1e-8)


def test_friction_only_takes_energy(rk4):
    plant = Pendulum(friction=0.3)
    xs = rk4(lambda x: plant(x, jnp.zeros(1), 0.0), plant.at_rest(0.3), 1e-3, 3000)
    energy = 0.5 * xs[:, 1] ** 2 + 9.8 * jnp.cos(xs[:, 0])
    assert (jnp.diff(energy) < 0).all()


def test_upright_and_hanging_are_at_rest_and_only_hanging_is_stable():
    plant = Pendulum()
    for angle, stable in ((0.0, False), (np.pi, True)):
        x = plant.at_rest(angle)
        np.testing.assert_allclose(plant(x, jnp.zeros(1), 0.0), 0, atol=1e-14)
        poles = np.linalg.eigvals(jax.jacfwd(lambda x: plant(x, jnp.zeros(1), 0.0))(x))
        assert (poles.real < 0).all() == stable


def test_the_hand_is_the_bob():
    plant = Pendulum(l=0.5)
    np.testing.assert_allclose(plant.hand(plant.at_rest(0.0)), [0, 0.5], atol=1e-16)
    np.testing.assert_allclose(plant.hand(plant.at_rest(np.pi / 2)), [0.5, 0], atol=1e-16)
    velocity = plant.hand_velocity(jnp.array([np.pi / 2, 2.0]))
    np.testing.assert_allclose(velocity, [0, -1], atol=1e-15)


@pytest.mark.parametrize(
    ("name", "value"),
    [("m", 0), ("m", -1.0), ("l", np.nan), ("l", [1.0, 2.0]), ("friction", -0.1), ("g", np.inf)],
)
def test_an_impossible_parameter_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=f"^{name}:"):
        Pendulum(**{name: value})


def test_bounds_are_an_argument():
    assert Pendulum().control_bounds is None
    lower, upper = Pendulum(control_bounds=(-2, 2)).control_bounds
    assert (lower.shape, upper.shape) == ((1,), (1,))
    with pytest.raises(ValueError, match="control_bounds"):
        Pendulum(control_bounds=([-1, -1], [1, 1]))
