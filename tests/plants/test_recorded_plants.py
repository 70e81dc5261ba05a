"""The plants' equations give the numbers that they gave before bodies were made of parts."""

import jax
import numpy as np
import pytest

import jaxctrl as jc
from jaxctrl import plants as p

RECORDED = {
    "Pendulum": (
        lambda: p.Pendulum(m=1.7, l=0.6, g=3.1, friction=0.2),
        [0.24074894576212863, 4.7855063710615635],
    ),
    "CartPole": (
        lambda: p.CartPole(M=1.3, m=0.4, l=0.7),
        [-0.7711998780320526, -0.6533390737801259, 1.086467316499275, -4.848759901778976],
    ),
    "Acrobot": (
        lambda: p.Acrobot(),
        [-0.7711998780320526, -0.6533390737801259, -4.192125624874682, 4.688541269148809],
    ),
    "PlanarQuadrotor": (
        lambda: p.PlanarQuadrotor(m=1.4, l=0.5),
        [
            -0.6533390737801259,
            0.4216650041703394,
            0.8789288631552211,
            -0.6789334729405152,
            -9.111508134753423,
            1.2989963240366884,
        ],
    ),
    "TorqueArm": (
        lambda: p.TorqueArm(m2=1.0),
        [-0.7711998780320526, -0.6533390737801259, -19.172921582076125, 59.231092875389024],
    ),
    "MuscleArm": (
        lambda: p.MuscleArm(active_state="brown"),
        [
            -0.7711998780320526,
            -0.6533390737801259,
            -62.75319929758296,
            160.73418362056378,
            1.3506033763734582,
            -0.23045291552952138,
            2.3664983371003956,
            -7.041146078751076,
            7.564772312800523,
            -4.552199229458143,
        ],
    ),
    "MuscleArm constant": (
        lambda: p.MuscleArm(
            arms="constant", active_state="brown", pcsa=12.0, activation_time=0.04, I1=0.03
        ),
        [
            -0.7711998780320526,
            -0.6533390737801259,
            -45.5974729703284,
            124.0233113750763,
            1.4780187892388787,
            -0.23045291552952138,
            2.44319534854504,
            -7.041146078751076,
            9.151282998091443,
            -4.552199229458143,
        ],
    ),
    "Chain": (
        lambda: p.Chain(3, gravity=9.81),
        [
            -0.6533390737801259,
            0.4216650041703394,
            0.8789288631552211,
            -93.67866824817456,
            199.46344586066874,
            -147.65300577482503,
        ],
    ),
    "InField": (
        lambda: p.InField(p.MuscleArm(active_state="brown"), p.Curl(13.0)),
        [
            -0.7711998780320526,
            -0.6533390737801259,
            -73.53245117006544,
            189.05521695046625,
            1.3506033763734582,
            -0.23045291552952138,
            2.3664983371003956,
            -7.041146078751076,
            7.564772312800523,
            -4.552199229458143,
        ],
    ),
    "Channel": (
        lambda: p.InField(p.TorqueArm(), p.Channel([0.0, 0.4], [0.1, 0.5])),
        [-0.7711998780320526, -0.6533390737801259, -271.09598344951144, 2669.4579087684374],
    ),
}


@pytest.mark.parametrize("name", RECORDED)
def test_rates_of_change_are_those_recorded(name):
    build, want = RECORDED[name]
    plant = build()
    x, u = 0.9 * np.cos(1.3 * np.arange(plant.nx)), 0.5 + 0.4 * np.sin(2.0 * np.arange(plant.nu))
    if plant.nx == 10:
        x[4:] = np.abs(x[4:])  # activations
    got = jax.jit(lambda plant: plant(x, u, 0.3))(plant)
    np.testing.assert_allclose(got, want, rtol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("solver", "cost"),
    [(jc.ILQR(), 5.005778571183753e-06), (jc.DDP(), 5.0057785710943416e-06)],
)
def test_the_muscle_arms_optimum_is_the_one_recorded(solver, cost):
    """Where both stop, about 1e-11 apart."""
    benchmark = jc.problems.load("muscle-arm-brown")
    solution = jc.solve(benchmark.problem, solver, benchmark.x0, benchmark.us)
    np.testing.assert_allclose(solution.cost, cost, rtol=1e-12)
