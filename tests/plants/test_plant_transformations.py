import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxctrl import plants
from jaxctrl.plants import Chain, MuscleArm, Pendulum, TorqueArm

PLANTS = {
    "pendulum": Pendulum,
    "torque arm": TorqueArm,
    "muscle arm": MuscleArm,
    "chain": lambda **kwargs: Chain(3, gravity=9.81, **kwargs),
}
BOUNDED = {"control_bounds": (-1.0, 1.0)}


@pytest.fixture(params=PLANTS)
def build(request):
    return PLANTS[request.param]


def states(plant, num=6):
    """States away from the muscles' kinks: u above a for some muscles and below it for others."""
    rng = np.random.default_rng(0)
    n = plant.num_joints
    q, dq = rng.uniform(0.3, 2.3, (num, n)), rng.uniform(-1.5, 1.5, (num, n))
    a = rng.uniform(0.2, 0.5, (num, plant.nx - 2 * n))
    u = np.where(rng.random((num, plant.nu)) < 0.5, 0.1, 0.8)
    return jnp.asarray(np.hstack([q, dq, a])), jnp.asarray(u)


def responses(plant, xs, us):
    """Return what a plant computes along states: derivatives, hands, and hand velocities."""
    return jax.vmap(
        lambda x, u: jnp.concatenate([plant(x, u, 0.0), plant.hand(x), plant.hand_velocity(x)])
    )(xs, us)


def test_compiled_equals_eager(build):
    plant = build()
    xs, us = states(plant, 1)
    got = jax.jit(lambda plant, x, u: plant(x, u, 0.0))(plant, xs[0], us[0])
    np.testing.assert_allclose(got, plant(xs[0], us[0], 0.0), rtol=1e-12, atol=1e-12)


def test_a_batch_of_plants_and_states_equals_a_loop(build):
    plant = build()
    xs, us = states(plant, 3)
    scaled = [jax.tree.map(lambda leaf, s=s: s * leaf, plant) for s in (0.9, 1.0, 1.2)]
    one = jax.jit(lambda plant, x, u: plant(x, u, 0.0))
    want = [one(*each) for each in zip(scaled, xs, us, strict=True)]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *scaled)
    got = jax.jit(jax.vmap(lambda plant, x, u: plant(x, u, 0.0)))(stacked, xs, us)
    np.testing.assert_allclose(got, want, rtol=1e-11, atol=1e-11)


def test_the_gradient_of_every_leaf_is_the_finite_difference(build):
    plant = build(**BOUNDED)
    xs, us = states(plant)
    vector, rebuild = ravel_pytree(plant)
    weights = np.random.default_rng(1).normal(size=responses(plant, xs, us).shape)

    def loss(vector):
        return jnp.sum(weights * responses(rebuild(vector), xs, us))

    gradient = jax.jit(jax.grad(loss))(vector)
    assert jnp.isfinite(gradient).all()
    for path, leaf in jax.tree_util.tree_leaves_with_path(rebuild(gradient)):
        name = jax.tree_util.keystr(path)
        assert jnp.any(leaf != 0) or "control" in name, name
    h = 1e-6 * jnp.maximum(0.01, jnp.abs(vector))
    losses = jax.jit(jax.vmap(loss))
    want = (losses(vector + jnp.diag(h)) - losses(vector - jnp.diag(h))) / (2 * h)
    np.testing.assert_allclose(gradient, want, rtol=1e-6, atol=1e-6 * float(jnp.abs(want).max()))


def test_derivatives_of_the_state_and_control_are_the_finite_differences(build):
    """Finite at rest without control too, which is where muscles have their kinks."""
    plant = build()
    z = jnp.hstack(states(plant))
    rest = jnp.zeros_like(z[:1]).at[:, : plant.num_joints].set(0.5)
    f = lambda z: plant(z[: plant.nx], z[plant.nx :], 0.0)  # noqa: E731
    jacobians = jax.jit(jax.vmap(lambda z: (jax.jacfwd(f)(z), jax.jacrev(f)(z))))
    with jax.debug_nans(True):
        forward, reverse = jacobians(jnp.concatenate([z, rest]))
    np.testing.assert_allclose(forward, reverse, rtol=1e-10, atol=1e-10)
    h, many = 1e-6, jax.jit(jax.vmap(f))
    for i in range(z.shape[1]):
        step = h * jnp.eye(z.shape[1])[i]
        want = (many(z + step) - many(z - step)) / (2 * h)
        atol = 1e-7 * float(jnp.abs(forward).max())
        np.testing.assert_allclose(forward[:-1, :, i], want, rtol=1e-6, atol=atol)


def test_another_parameter_does_not_compile_again(build):
    plant = build()
    xs, us = states(plant, 1)
    traces = 0

    @jax.jit
    def f(plant, x, u):
        nonlocal traces
        traces += 1
        return plant(x, u, 0.0)

    first = f(plant, xs[0], us[0])
    leaves, structure = jax.tree.flatten(plant)
    for i in range(len(leaves)):
        changed = [leaf * 1.01 if i == j else leaf for j, leaf in enumerate(leaves)]
        f(jax.tree.unflatten(structure, changed), xs[0], us[0])
    again = f(build(), xs[0], us[0])
    assert traces == 1
    np.testing.assert_array_equal(first, again)


def test_without_x64_everything_is_float32(build, float32):
    plant = build(**BOUNDED)
    assert {leaf.dtype for leaf in jax.tree.leaves(plant)} == {np.dtype("float32")}
    x, u = jnp.zeros(plant.nx).at[: plant.num_joints].set(0.5), plant.nominal_control
    for f in (lambda x, u: plant(x, u, 0.0), lambda x, u: plant.hand_velocity(x)):
        value = jax.jit(f)(x, u)
        assert value.dtype == jnp.float32 and jnp.isfinite(value).all()


def test_float32_leaves_and_states_stay_float32_though_x64_is_on(build):
    plant = build()
    xs, us = states(plant)
    narrow = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), plant)
    compiled = jax.jit(responses)
    got = compiled(narrow, xs.astype(jnp.float32), us.astype(jnp.float32))
    assert got.dtype == jnp.float32
    want = compiled(plant, xs, us)
    np.testing.assert_allclose(got, want, rtol=1e-3, atol=1e-4 * float(jnp.abs(want).max()))
    mixed = jax.eval_shape(lambda x, u: narrow(x, u, 0.0), xs[0], us[0])
    assert mixed.dtype == jnp.float64


@pytest.mark.parametrize(
    ("make", "at_rest"),
    [
        (lambda p: Pendulum(l=p), lambda plant: plant.at_rest(0.5)),
        (lambda p: TorqueArm(l1=p), lambda plant: plant.at_rest(0.5, 0.6)),
        (lambda p: MuscleArm(pcsa=p), lambda plant: plant.at_rest(0.5, 0.6, activation=0.2)),
        (lambda p: Chain(2, mass=[p, 1.0]), lambda plant: plant.at_rest(0.5)),
    ],
)
def test_plants_can_be_built_of_traced_parameters(make, at_rest):
    def loss(p):
        plant = make(p)
        return jnp.sum(plant(at_rest(plant) + 0.1, plant.nominal_control + 0.1, 0.0) ** 2)

    values = jnp.array([0.3, 0.4])
    gradients = jax.jit(jax.vmap(jax.grad(loss)))(values)
    h, compiled = 1e-6, jax.jit(jax.vmap(loss))
    want = (compiled(values + h) - compiled(values - h)) / (2 * h)
    np.testing.assert_allclose(gradients, want, rtol=1e-6)


def test_a_known_wrong_number_is_refused_while_tracing_too():
    with pytest.raises(ValueError, match=r"^m:"):
        jax.jit(lambda x: Pendulum(m=-1.0)(x, jnp.zeros(1), 0.0))(jnp.zeros(2))
    with pytest.raises(ValueError, match=r"^mass: shape"):
        jax.jit(lambda m: Chain(2, mass=m).mass)(jnp.ones(3))


def test_states_at_rest_follow_the_dtype_of_the_plant():
    arm = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), TorqueArm())
    assert arm.at_rest(0.5, 1).dtype == jnp.float32
    assert arm.at_rest(jnp.array(0.5), 1).dtype == jnp.float64
    assert TorqueArm().at_rest(np.float32(0.5), 1).dtype == jnp.float64


def test_plants_are_frozen(build):
    with pytest.raises(AttributeError):
        build().control_bounds = None


def test_plants_are_final_and_documented():
    for name in plants.__all__:
        thing = getattr(plants, name)
        if inspect.isclass(thing) and not name.startswith("Abstract"):
            assert issubclass(thing, eqx.Module) and not thing.__subclasses__()
            for method, value in vars(thing).items():
                if inspect.isfunction(value) and not method.startswith("_"):
                    assert value.__doc__, f"{name}.{method}"
        if callable(thing):
            assert thing.__doc__, name
