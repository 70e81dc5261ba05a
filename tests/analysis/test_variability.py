"""Ellipses of endpoints and the uncontrolled manifold."""

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.stats import ortho_group

from jaxctrl import analysis

RNG = np.random.default_rng(0)
JACOBIAN = np.array([[-0.5, -0.3, -0.1], [0.4, 0.2, 0.15]])
POSTURES = RNG.standard_normal((4000, 3))


def test_the_ellipse_has_the_axes_angle_and_area_of_its_distribution():
    turn = np.array([[np.cos(0.6), -np.sin(0.6)], [np.sin(0.6), np.cos(0.6)]])
    normal = RNG.standard_normal((200, 2))
    normal = (normal - normal.mean(axis=0)) @ np.linalg.inv(
        np.linalg.cholesky(np.cov(normal.T))
    ).T  # mean 0 and covariance 1, exactly
    ellipse = analysis.endpoint_ellipse(normal * [0.02, 0.005] @ turn.T + [0.1, 0.3], coverage=0.9)
    scale = np.sqrt(-2 * np.log(0.1))
    np.testing.assert_allclose(ellipse.centre, [0.1, 0.3])
    np.testing.assert_allclose(ellipse.half_axes, scale * np.array([0.02, 0.005]))
    assert ellipse.angle == pytest.approx(0.6)
    assert ellipse.area == pytest.approx(np.pi * scale**2 * 0.02 * 0.005)
    np.testing.assert_allclose(
        ellipse.covariance, turn @ np.diag([0.02**2, 0.005**2]) @ turn.T, atol=1e-15
    )


def test_the_ellipse_holds_the_fraction_that_it_says():
    points = RNG.multivariate_normal([0, 0], [[4e-4, 1e-4], [1e-4, 1e-4]], size=20_000)
    ellipse = analysis.endpoint_ellipse(points)
    offsets = points - ellipse.centre
    c, s = np.cos(ellipse.angle), np.sin(ellipse.angle)
    along = offsets @ [c, s] / ellipse.half_axes[0]
    across = offsets @ [-s, c] / ellipse.half_axes[1]
    assert np.mean(along**2 + across**2 < 1) == pytest.approx(0.95, abs=0.005)


@pytest.mark.parametrize(
    ("direction", "angle"), [((0, -1), np.pi / 2), ((-1, 0), 0.0), ((1, -1), -np.pi / 4)]
)
def test_points_on_a_line_give_a_flat_ellipse_along_it(direction, angle):
    ellipse = analysis.endpoint_ellipse(np.arange(5.0)[:, None] * direction)
    assert ellipse.angle == pytest.approx(angle)
    assert ellipse.area == pytest.approx(0, abs=1e-6)


def test_isotropic_noise_has_ratio_one():
    found = analysis.uncontrolled_manifold(0.02 * POSTURES + 1, JACOBIAN)
    assert found.ratio == pytest.approx(1, abs=0.05)
    assert found.redundant == pytest.approx(0.02**2, rel=0.05)
    assert found.task == pytest.approx(0.02**2, rel=0.05)


def test_variances_equal_those_of_coordinates_along_and_across_the_null_space():
    free = null_space(JACOBIAN)
    bound = null_space(free.T)
    spread = POSTURES[:50] @ RNG.standard_normal((3, 3))
    found = analysis.uncontrolled_manifold(spread, JACOBIAN)
    assert found.redundant == pytest.approx((spread @ free).var(axis=0, ddof=1).mean())
    assert found.task == pytest.approx((spread @ bound).var(axis=0, ddof=1).mean())


def test_noise_in_the_null_space_alone_has_an_infinite_ratio_and_in_the_task_alone_zero():
    free = null_space(JACOBIAN)
    noise = RNG.standard_normal((20, 1))
    assert analysis.uncontrolled_manifold(noise @ free.T + 1, JACOBIAN).ratio == np.inf
    bound = RNG.standard_normal((20, 2)) @ JACOBIAN
    assert analysis.uncontrolled_manifold(bound + 1, JACOBIAN).ratio == 0
    assert np.isnan(analysis.uncontrolled_manifold(np.ones((5, 3)), JACOBIAN).ratio)


def test_turning_joints_and_jacobian_together_changes_nothing():
    turn = ortho_group.rvs(3, random_state=0)
    spread = POSTURES[:30] * [1, 2, 3]
    here = analysis.uncontrolled_manifold(spread, JACOBIAN)
    there = analysis.uncontrolled_manifold(spread @ turn.T, JACOBIAN @ turn.T)
    assert there.redundant == pytest.approx(here.redundant)
    assert there.task == pytest.approx(here.task)


def test_combining_the_task_variables_changes_nothing():
    mixed = np.array([[2.0, 1.0], [-1.0, 3.0]]) @ JACOBIAN
    here = analysis.uncontrolled_manifold(POSTURES[:30] * [1, 2, 3], JACOBIAN)
    there = analysis.uncontrolled_manifold(POSTURES[:30] * [1, 2, 3], mixed)
    assert there.ratio == pytest.approx(here.ratio)


def test_instants_are_taken_one_by_one():
    samples = RNG.standard_normal((10, 4, 3))
    jacobians = RNG.standard_normal((4, 2, 3))
    found = analysis.uncontrolled_manifold(samples, jacobians)
    for k in range(4):
        alone = analysis.uncontrolled_manifold(samples[:, k], jacobians[k])
        assert found.ratio[k] == pytest.approx(alone.ratio)


WRONG = {
    "points": (lambda: analysis.endpoint_ellipse(np.ones((5, 3))), r"points: shape \(5, 3\) given"),
    "two points": (lambda: analysis.endpoint_ellipse(np.ones((2, 2))), "points: at least 3 .* 2"),
    "nan points": (
        lambda: analysis.endpoint_ellipse(np.full((5, 2), np.nan)),
        "points: no finite sample",
    ),
    "a nan point": (
        lambda: analysis.endpoint_ellipse([[0, 1], [1, 1], [2, np.nan], [3, 1]]),
        "points: finite numbers are wanted",
    ),
    "coverage": (lambda: analysis.endpoint_ellipse(np.eye(3, 2), coverage=1), "coverage: a frac"),
    "as many tasks as joints": (
        lambda: analysis.uncontrolled_manifold(POSTURES, np.eye(3)),
        "jacobian: fewer rows than columns are wanted, got 3 of 3 columns",
    ),
    "rank": (
        lambda: analysis.uncontrolled_manifold(POSTURES, np.ones((2, 3))),
        "jacobian: rank 2 is wanted, got a lower one",
    ),
    "zero jacobian": (
        lambda: analysis.uncontrolled_manifold(POSTURES, np.zeros((1, 3))),
        "jacobian: rank 1 is wanted",
    ),
    "joints": (
        lambda: analysis.uncontrolled_manifold(POSTURES, np.ones((1, 4))),
        r"jacobian: shape \(1, 4\) given, wanted \(m, 3\)",
    ),
    "instants": (
        lambda: analysis.uncontrolled_manifold(np.ones((5, 4, 3)), JACOBIAN),
        r"jacobian: shape \(2, 3\) given, wanted \(4, m, 3\)",
    ),
    "one trial": (
        lambda: analysis.uncontrolled_manifold(np.ones((1, 3)), JACOBIAN),
        "samples: at least 2 trials are wanted, got 1",
    ),
    "samples": (
        lambda: analysis.uncontrolled_manifold(np.ones(3), JACOBIAN),
        r"samples: shape \(3,\) given, wanted \(trials, n\)",
    ),
    "nan samples": (
        lambda: analysis.uncontrolled_manifold(np.full((5, 3), np.nan), JACOBIAN),
        "samples: finite numbers are wanted",
    ),
    "nan jacobian": (
        lambda: analysis.uncontrolled_manifold(POSTURES, JACOBIAN * np.nan),
        "jacobian: finite numbers are wanted",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_is_refused_by_name(case):
    call, message = WRONG[case]
    with pytest.raises(ValueError, match=message):
        call()
