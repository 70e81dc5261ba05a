"""How close a path comes to a disc, and how far two paths lie apart, against dense sampling."""

import itertools

import numpy as np
import pytest

from jaxctrl.analysis import clearance, path_distance


def dense(path, n=2000):
    """The path's segments, finely sampled."""
    s = np.linspace(0, 1, n)[:, None]
    return np.concatenate([a + s * (b - a) for a, b in itertools.pairwise(path)])


@pytest.mark.parametrize("seed", range(5))
def test_clearance_is_the_least_distance_of_a_densely_sampled_path(seed):
    rng = np.random.default_rng(seed)
    path, centre = rng.normal(size=(12, 2)), rng.normal(size=2)
    wanted = np.linalg.norm(dense(path) - centre, axis=1).min() - 0.1
    assert abs(clearance(path, centre, 0.1) - wanted) < 1e-3


def test_a_segment_that_cuts_the_rim_between_samples_is_found():
    path = np.array([[-1.0, 0.1], [1.0, 0.1]])  # both samples lie 1 m away
    np.testing.assert_allclose(clearance(path, [0.0, 0.0], 0.3), -0.2, atol=1e-15)


def test_beyond_its_ends_a_segment_is_as_far_as_its_end():
    path = np.array([[1.0, 1.0], [2.0, 1.0]])
    np.testing.assert_allclose(clearance(path, [0.0, 0.0], 0.5), np.sqrt(2) - 0.5, rtol=1e-15)


def test_a_hand_that_stands_still_keeps_its_distance():
    path = np.tile([3.0, 4.0], (4, 1))
    np.testing.assert_allclose(clearance(path, [0.0, 0.0], 1.0), 4.0, rtol=1e-15)


def test_batches_are_measured_side_by_side_and_gaps_are_nan():
    rng = np.random.default_rng(1)
    paths = rng.normal(size=(2, 3, 7, 2))
    got = clearance(paths, [0.1, 0.2], 0.05)
    assert got.shape == (2, 3)
    for i in np.ndindex(2, 3):
        np.testing.assert_allclose(got[i], clearance(paths[i], [0.1, 0.2], 0.05), rtol=1e-14)
    paths[0, 1, 3] = np.nan
    np.testing.assert_array_equal(
        np.isnan(clearance(paths, [0.1, 0.2], 0.05)), [[False, True, False], 3 * [False]]
    )


def test_paths_shifted_across_their_line_are_that_far_apart():
    path = np.stack([np.linspace(0, 1, 30), np.zeros(30)], axis=1)
    np.testing.assert_allclose(path_distance(path, path + np.array([0.0, 0.02])), 0.02, rtol=1e-12)


def test_the_distance_does_not_depend_on_when_points_are_passed():
    s = np.linspace(0, 1, 400)
    even, slow = (
        (np.stack([p, np.sin(3 * p)], axis=1)) for p in (s, 10 * s**3 - 15 * s**4 + 6 * s**5)
    )
    assert path_distance(even, slow) < 1e-4
    assert path_distance(even, slow[:-100]) > 0.02


def test_the_distance_equals_an_integral_over_arc_lengths():
    """Of a straight line and a quarter of a circle, both with known arc lengths."""
    phi = np.linspace(0, np.pi / 2, 4000)
    arc = np.stack([np.sin(phi), 1 - np.cos(phi)], axis=1)
    line = np.stack([np.linspace(0, 1, 50), np.linspace(0, 1, 50)], axis=1)
    s = np.linspace(0, 1, 20001)
    apart = np.stack([np.sin(s * np.pi / 2) - s, 1 - np.cos(s * np.pi / 2) - s], axis=1)
    wanted = np.sqrt(np.mean(np.sum(apart**2, axis=1)))
    np.testing.assert_allclose(path_distance(arc, line, num_samples=4001), wanted, rtol=1e-3)
    np.testing.assert_allclose(path_distance(arc, line), path_distance(line, arc), rtol=1e-12)
    assert path_distance(arc, arc) == 0


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: clearance(np.zeros((1, 2)), [0, 0], 1.0), "^path"),
        (lambda: clearance(np.zeros((5, 3)), [0, 0], 1.0), "^path"),
        (lambda: clearance(np.full((5, 2), np.nan), [0, 0], 1.0), "^path"),
        (lambda: clearance(np.zeros((5, 2)), [0, 0, 0], 1.0), "^centre"),
        (lambda: clearance(np.zeros((5, 2)), [0, 0], [1.0, 2.0]), "^radius"),
        (lambda: path_distance(np.zeros((5, 2)), np.ones((5, 2))), "^path: a path of some length"),
        (lambda: path_distance(np.eye(2), np.ones((5, 2))), "^other: a path of some length"),
        (lambda: path_distance(np.eye(2), np.ones((2, 5, 2))), "^other: one path"),
        (lambda: path_distance([[0, 0], [np.nan, 1], [1, 1]], np.eye(2)), "^path"),
    ],
)
def test_misuse_is_named(call, match):
    with pytest.raises(ValueError, match=match):
        call()
