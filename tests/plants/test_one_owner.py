"""Every number of a plant has one owner: edited in place, the plant is as if built with it.

What is derived and stored as well would be stale after `eqx.tree_at`, without an error.
"""

import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc
from jaxctrl import plants
from jaxctrl.plants import MuscleArm, TorqueArm

BOUNDS = {"control_bounds": (-1.0, 2.0)}
SKELETON = TorqueArm().skeleton


def built(cls, *args, **given):
    return lambda **changed: cls(*args, **(given | changed))


def musculoskeletal(**changed):
    parts = {"skeleton": SKELETON, "paths": MuscleArm().paths, "muscles": MuscleArm().muscles}
    return plants.MusculoskeletalArm(**(parts | changed))


# With what is derived left to the default, and with every number given.
PLANTS = {
    "Acrobot": [built(plants.Acrobot), built(plants.Acrobot, centre=[0.4, 0.6], **BOUNDS)],
    "Car": [built(plants.Car, **BOUNDS)],
    "CartPole": [built(plants.CartPole, **BOUNDS)],
    "Chain": [built(plants.Chain, 3), built(plants.Chain, 2, gravity=9.8, **BOUNDS)],
    "FreeHand": [built(plants.FreeHand)],
    "FunctionPlant": [
        built(jc.FunctionPlant, lambda x, u, t, p: p * x + u, nx=1, nu=1, params=2.0, **BOUNDS)
    ],
    "InField": [built(plants.InField, arm=TorqueArm(), field=plants.Curl())],
    "MuscleArm": [built(MuscleArm), built(MuscleArm, arms="constant", beta=0.001)],
    "MusculoskeletalArm": [musculoskeletal],
    "Pendulum": [built(plants.Pendulum, **BOUNDS)],
    "PlanarQuadrotor": [
        built(plants.PlanarQuadrotor),
        built(plants.PlanarQuadrotor, inertia=0.1, **BOUNDS),
    ],
    "RateControlled": [built(plants.RateControlled, arm=TorqueArm())],
    "TorqueArm": [built(TorqueArm, **BOUNDS)],
}
CASES = [(name, build) for name, builds in PLANTS.items() for build in builds]
# A part is handed over as it is: what is in it is edited in it.
PARTS = {"InField", "RateControlled", "MusculoskeletalArm"}


def leaves(plant):
    """Return every array leaf as (its path, its value)."""
    return jax.tree_util.tree_flatten_with_path(plant)[0]


def edited(plant, path, value):
    def where(tree):
        for key in path:
            tree = getattr(tree, key.name) if hasattr(key, "name") else tree[key.idx]
        return tree

    return eqx.tree_at(where, plant, value)


def anew(name, build, plant, path, value):
    """Build the plant with one number changed, through its constructor's arguments."""
    first = path[0].name
    if name in PARTS or isinstance(path[-1], jax.tree_util.SequenceKey):
        argument = "arm" if name == "RateControlled" else first
        return build(**{argument: getattr(edited(plant, path, value), first)})
    return build(**{path[-1].name.removeprefix("given_"): value})


@eqx.filter_jit
def derived(plant):
    """Return every public property, and what the plant computes in a state."""
    names = {
        name for cls in type(plant).__mro__ for name, value in vars(cls).items()
        if name[0] != "_" and not inspect.isroutine(value) and hasattr(plant, name)
    } | {"control_bounds", "nominal_control"}  # fmt: skip
    x = 0.7 * jnp.cos(jnp.arange(plant.nx) + 0.3) ** 2
    u = 0.5 + 0.4 * jnp.sin(2.0 * jnp.arange(plant.nu))
    found = {name: getattr(plant, name) for name in sorted(names)}
    found["()"] = jc.Problem(plant, jc.QuadraticCost(), num_steps=1, dt=0.1).step(x, u, 0.0)
    if isinstance(plant, jc.AbstractHand):
        found |= {"hand": plant.hand(x), "hand_velocity": plant.hand_velocity(x)}
    if isinstance(plant, jc.AbstractArm):
        q = x[: plant.num_joints]
        found |= {"M": plant.mass_matrix(q), "torque": plant.joint_torque(x, u)}
    if isinstance(plant, MuscleArm | plants.MusculoskeletalArm):
        found |= {"length": plant.muscle_length(q), "tension": plant.muscle_tension(x)}
    return found


@pytest.mark.parametrize(("name", "build"), CASES)
def test_an_edited_plant_is_the_plant_built_anew(name, build):
    plant = build()
    for path, leaf in leaves(plant):
        label = name + jax.tree_util.keystr(path)
        if path[-1] == jax.tree_util.GetAttrKey("nominal_control") and not leaf.any():
            continue  # zeros, of which nothing is made
        value = jnp.asarray(leaf) * 1.03
        got, want = edited(plant, path, value), anew(name, build, plant, path, value)
        assert eqx.tree_equal(got, want, typematch=True, rtol=1e-15), label
        other = derived(got)
        for what, number in derived(want).items():
            assert eqx.tree_equal(other[what], number, rtol=1e-15, atol=1e-15), (label, what)


def test_every_plant_is_among_them():
    known = {
        name for name in plants.__all__
        if inspect.isclass(getattr(plants, name))
        and issubclass(getattr(plants, name), jc.AbstractPlant)
    }  # fmt: skip
    assert known == set(PLANTS)


def test_what_is_derived_follows():
    """The three that were stale."""
    acrobot = eqx.tree_at(lambda p: p.l, plants.Acrobot(), jnp.array([1.5, 0.5]))
    np.testing.assert_array_equal(acrobot.centre, [1.5, 0.5])
    robot = eqx.tree_at(lambda p: p.m, plants.PlanarQuadrotor(), jnp.array(2.0))
    np.testing.assert_allclose(robot.nominal_control, [9.81, 9.81])
    np.testing.assert_allclose(robot.inertia, 0.2 * 2 * 0.3**2)
    robot = eqx.tree_at(lambda p: p.l, robot, jnp.array(0.6))
    np.testing.assert_allclose(robot.inertia, 0.2 * 2 * 0.6**2)


def test_what_is_given_stays_and_can_be_edited():
    acrobot = plants.Acrobot(centre=0.5)
    acrobot = eqx.tree_at(lambda p: p.l, acrobot, 2 * acrobot.l)
    np.testing.assert_array_equal(acrobot.centre, [0.5, 0.5])
    acrobot = eqx.tree_at(lambda p: p.centre, acrobot, jnp.array([0.3, 0.4]))
    np.testing.assert_array_equal(acrobot.centre, [0.3, 0.4])
