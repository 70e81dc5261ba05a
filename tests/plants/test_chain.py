import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jaxctrl.plants import Chain, Pendulum, TorqueArm


def uneven(n, **kwargs):
    rng = np.random.default_rng(n)
    length, mass, friction = rng.uniform(0.1, 0.5, n), rng.uniform(0.2, 2, n), rng.uniform(0, 1, n)
    return dict(length=length, mass=mass, friction=friction) | kwargs


def energies(q, dq, length, mass, gravity):
    """Kinetic and potential energy of rods, each by its centre's velocity and its own spin."""
    n = len(length)
    before, to_centre = np.tri(n), np.tri(n) - 0.5 * np.eye(n)

    def centres(q):
        phi = before @ q
        return to_centre @ (length[:, None] * jnp.stack([jnp.cos(phi), jnp.sin(phi)], 1))

    v = jax.jvp(centres, (q,), (dq,))[1]
    kinetic = 0.5 * jnp.sum(mass * ((v**2).sum(1) + length**2 / 12 * (before @ dq) ** 2))
    return kinetic, gravity * jnp.sum(mass * centres(q)[:, 1])


@pytest.mark.parametrize("n", [1, 2, 5, 16])
def test_forward_dynamics_are_those_of_the_lagrangian(n):
    parameters = uneven(n)
    rng = np.random.default_rng(n)
    xs = np.hstack([rng.uniform(-np.pi, np.pi, (10, n)), rng.uniform(-3, 3, (10, n))])
    us = rng.uniform(-2, 2, (10, n))

    def lagrangian(chain, x, u):
        q, dq = x[:n], x[n:]
        rods = (parameters["length"], parameters["mass"], chain.gravity)
        kinetic = lambda q: 0.5 * dq @ chain.mass_matrix(q) @ dq  # noqa: E731
        potential = lambda q: energies(q, dq, *rods)[1]  # noqa: E731
        momentum_rate = jax.jvp(lambda q: chain.mass_matrix(q) @ dq, (q,), (dq,))[1]
        force = u - chain.friction * dq - momentum_rate
        force += jax.grad(kinetic)(q) - jax.grad(potential)(q)
        return jnp.concatenate([dq, jnp.linalg.solve(chain.mass_matrix(q), force)])

    over_states = lambda f: jax.jit(jax.vmap(f, (None, 0, 0)))  # noqa: E731
    forward, oracle = over_states(lambda chain, x, u: chain(x, u, 0.0)), over_states(lagrangian)
    for gravity in (0.0, 9.81):
        for friction in (0.0, parameters["friction"]):
            chain = Chain(n, **(parameters | dict(friction=friction, gravity=gravity)))
            want = oracle(chain, xs, us)
            atol = 1e-9 * np.abs(want).max()
            np.testing.assert_allclose(forward(chain, xs, us), want, rtol=1e-9, atol=atol)


@pytest.mark.parametrize("n", [1, 5, 16])
def test_mass_matrix_and_kinetic_energy_are_those_of_the_rods(n):
    parameters = uneven(n)
    chain = Chain(n, **parameters)
    rng = np.random.default_rng(n)
    q, dq = rng.uniform(-np.pi, np.pi, n), rng.uniform(-3, 3, n)

    @jax.jit
    def both(q, dq):
        kinetic = lambda dq: energies(q, dq, chain.length, chain.mass, 0.0)[0]  # noqa: E731
        x = jnp.concatenate([q, dq])
        return chain.mass_matrix(q), jax.hessian(kinetic)(dq), chain.kinetic_energy(x)

    M, want, energy = both(q, dq)
    np.testing.assert_allclose(M, want, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(energy, 0.5 * dq @ want @ dq, rtol=1e-12)


def test_the_mass_matrix_is_positive_definite_on_a_grid():
    q = np.stack(np.meshgrid(*[np.linspace(-np.pi, np.pi, 7)] * 4), -1).reshape(-1, 4)
    M = jax.jit(jax.vmap(Chain(4, **uneven(4)).mass_matrix))(q)
    assert np.linalg.eigvalsh(M).min() > 0


def test_two_links_are_the_torque_arm():
    l1, l2, m1, m2, friction = 0.31, 0.27, 1.5, 0.8, (0.06, 0.03)
    chain = Chain(2, length=[l1, l2], mass=[m1, m2], friction=friction)
    rod = dict(I1=m1 * l1**2 / 3, I2=m2 * l2**2 / 3, s2=l2 / 2)
    arm = TorqueArm(m2=m2, l1=l1, l2=l2, friction=np.diag(friction), **rod)
    rng = np.random.default_rng(0)
    xs, us = rng.uniform(-2, 2, (50, 4)), rng.uniform(-1, 1, (50, 2))
    f = jax.jit(jax.vmap(lambda a, x, u: (a(x, u, 0.0), a.hand(x)), (None, 0, 0)))
    for got, want in zip(f(chain, xs, us), f(arm, xs, us), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(chain.mass_matrix(xs[0, :2]), arm.mass_matrix(xs[0, :2]), rtol=1e-13)


def test_one_hanging_rod_is_a_pendulum_of_two_thirds_its_length():
    l, m, g = 0.6, 1.3, 9.8
    chain = Chain(1, length=l, mass=m, friction=0.0, gravity=g)
    # m l^2/3 is the inertia, and m g l/2 the weight's arm, of a bob of 3/4 m at 2/3 l.
    bob = Pendulum(l=2 * l / 3, m=0.75 * m, g=g, friction=0.0)
    x, u = jnp.array([0.4, 1.1]), jnp.array([0.2])
    # The chain's angle counts anticlockwise from the x axis, the pendulum's clockwise from upright.
    flipped = bob(jnp.array([np.pi / 2 - x[0], -x[1]]), -u, 0.0)
    np.testing.assert_allclose(chain(x, u, 0.0), -flipped, rtol=1e-13)


def test_a_falling_chain_equals_scipys(rk4):
    parameters = uneven(3)
    chain, u = Chain(3, gravity=9.81, **parameters), np.array([0.5, -0.2, 0.1])
    start = np.array([-1.0, 0.4, 0.3, 0, 0, 0])

    @jax.jit
    def dynamics(x):
        q, dq = x[:3], x[3:]

        def lagrangian(q, dq):
            kinetic, potential = energies(q, dq, parameters["length"], parameters["mass"], 9.81)
            return kinetic - potential

        mixed = jax.jacfwd(jax.grad(lagrangian, 1), 0)(q, dq)
        force = u - parameters["friction"] * dq + jax.grad(lagrangian, 0)(q, dq) - mixed @ dq
        return jnp.concatenate([dq, jnp.linalg.solve(jax.hessian(lagrangian, 1)(q, dq), force)])

    xs = rk4(lambda x: chain(x, u, 0.0), start, 1e-3, 500)
    want = solve_ivp(lambda _, x: dynamics(x), (0, 0.5), start, rtol=1e-10, atol=1e-11)
    np.testing.assert_allclose(xs[-1], want.y[:, -1], atol=1e-7)


def drift(rk4, chain, x0, dt):
    xs = rk4(lambda x: chain(x, jnp.zeros(chain.nu), 0.0), x0, dt, round(1 / dt))
    energy = jax.jit(jax.vmap(lambda x: chain.kinetic_energy(x)))(xs)
    return jnp.abs(energy / energy[0] - 1).max()


@pytest.mark.parametrize("n", [8, 16])
def test_without_friction_and_torque_the_kinetic_energy_stays(rk4, n):
    rng = np.random.default_rng(n)
    q, turning = rng.uniform(-1, 1, n), rng.uniform(-1, 1, n)
    x0 = np.r_[q, np.diff(turning, prepend=0)]
    assert drift(rk4, Chain(n, friction=0.0), x0, 1e-3) < 1e-9


def test_the_drift_of_a_whipping_chain_is_the_integrators(rk4):
    """Links reach 13 rad/s here; the error of the Runge-Kutta rule falls with dt^4."""
    n, rng = 16, np.random.default_rng(2)
    x0 = np.r_[rng.uniform(-1, 1, n), 2 * rng.uniform(-1, 1, n)]
    coarse, fine = (drift(rk4, Chain(n, friction=0.0), x0, dt) for dt in (1e-3, 5e-4))
    assert 14 < coarse / fine < 18


@pytest.mark.parametrize("gravity", [0.0, 9.81])
def test_friction_only_takes_energy(rk4, gravity):
    n, chain = 4, Chain(4, gravity=gravity, **uneven(4))
    x0 = np.random.default_rng(1).uniform(-1, 1, 2 * n)
    xs = rk4(lambda x: chain(x, jnp.zeros(n), 0.0), x0, 1e-3, 1000)
    energy = jax.vmap(lambda x: sum(energies(x[:n], x[n:], chain.length, chain.mass, gravity)))(xs)
    assert (jnp.diff(energy) < 0).all()


def test_defaults_are_equal_links_of_an_arms_length_and_mass():
    for n in (1, 3, 10):
        chain = Chain(n)
        np.testing.assert_allclose(chain.length, np.full(n, 0.63 / n))
        np.testing.assert_allclose(chain.mass, np.full(n, 2.4 / n))
        np.testing.assert_allclose(chain.friction, np.full(n, 0.05 * (2 / n) ** 3))
        assert (chain.nx, chain.nu, chain.num_joints, float(chain.gravity)) == (2 * n, n, n, 0.0)


def test_the_hand_is_the_tip_of_the_last_link():
    chain = Chain(3, length=[0.3, 0.2, 0.1])
    np.testing.assert_allclose(chain.hand(chain.at_rest(0.0)), [0.6, 0.0], atol=1e-16)
    x = chain.at_rest([np.pi / 2, -np.pi / 2, np.pi / 2])
    np.testing.assert_allclose(chain.hand(x), [0.2, 0.4], atol=1e-15)
    x = x.at[3].set(2.0)
    np.testing.assert_allclose(chain.hand_velocity(x), [-0.8, 0.4], atol=1e-15)


def sizes(jaxpr):
    """Yield the size of every intermediate array, scan bodies included."""
    for equation in jaxpr.eqns:
        yield from (variable.aval.size for variable in equation.outvars)
        for value in equation.params.values():
            for inner in value if isinstance(value, tuple | list) else (value,):
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from sizes(inner)


def test_no_array_of_the_dynamics_grows_faster_than_the_chain():
    n = 40
    chain = Chain(n)
    jaxpr = jax.make_jaxpr(lambda x, u: chain(x, u, 0.0))(jnp.zeros(2 * n), jnp.zeros(n))
    assert max(sizes(jaxpr.jaxpr)) <= 2 * n


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("length", 0.0),
        ("length", [0.1, 0.2]),
        ("length", [0.1, 0.2, -0.1]),
        ("mass", np.nan),
        ("mass", np.ones((3, 1))),
        ("friction", -0.1),
        ("gravity", np.inf),
        ("control_bounds", 1.0),
    ],
)
def test_an_impossible_parameter_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=f"^{name}:"):
        Chain(3, **{name: value})


@pytest.mark.parametrize("n", [0, -1, 2.5])
def test_a_chain_has_a_whole_number_of_links(n):
    with pytest.raises((TypeError, ValueError), match=r"^n:"):
        Chain(n)


def test_angles_at_rest_are_one_per_joint():
    with pytest.raises(ValueError, match=r"^q:"):
        Chain(3).at_rest([0.1, 0.2])
