"""Wrong input is refused by name, with the shape got and the shape wanted."""

import numpy as np
import pytest

from jaxctrl import plot

TS = np.linspace(0.0, 1.0, 11)
ONES = np.ones
NANS = np.full((11, 2), np.nan)

WRONG = {
    "paths of three coordinates": (
        lambda: plot.hand_paths(ONES((11, 3))),
        r"paths: shape \(11, 3\) given, wanted \(N, 2\)",
    ),
    "a path of no samples": (
        lambda: plot.hand_paths(ONES((0, 2))),
        r"paths: shape \(0, 2\) given, wanted",
    ),
    "one entry of a list": (
        lambda: plot.hand_paths([ONES((11, 2)), ONES(11)]),
        r"paths\[1\]: shape \(11,\) given, wanted",
    ),
    "an empty list": (lambda: plot.hand_paths([]), r"paths: shape \(0,\) given, wanted"),
    "text": (lambda: plot.hand_paths("abc"), r"paths: real numbers of shape"),
    "complex": (lambda: plot.hand_paths(1j * ONES((11, 2))), r"paths: real numbers of shape"),
    "ragged": (lambda: plot.hand_paths([[0, 1], [2]]), r"paths: real numbers of shape"),
    "targets": (
        lambda: plot.hand_paths(ONES((11, 2)), ONES(3)),
        r"targets: shape \(3,\) given, wanted \(2,\) or \(n, 2\)",
    ),
    "starts": (lambda: plot.hand_paths(ONES((11, 2)), starts=1.0), r"starts: shape \(\) given"),
    "via": (lambda: plot.hand_paths(ONES((11, 2)), via=ONES(3)), r"via: shape \(3,\) given"),
    "obstacles": (
        lambda: plot.hand_paths(ONES((11, 2)), obstacles=ONES((1, 2))),
        r"obstacles: shape \(1, 2\) given, wanted \(3,\) or \(n, 3\)",
    ),
    "radius of an obstacle": (
        lambda: plot.hand_paths(ONES((11, 2)), obstacles=[0.1, 0.2, -0.3]),
        r"obstacles: .* a positive radius",
    ),
    "labels of the trials": (
        lambda: plot.hand_paths(ONES((8, 11, 2)), labels=list("abcdefgh")),
        r"labels: 8 given, wanted 1.*list of arrays",
    ),
    "all NaN": (lambda: plot.hand_paths(NANS), r"paths: no finite sample"),
    "speeds": (
        lambda: plot.speed_profiles(TS, ONES((2, 3, 11))),
        r"speeds: shape \(2, 3, 11\) given, wanted \(N,\)",
    ),
    "times of the speeds": (
        lambda: plot.speed_profiles(TS, ONES(10)),
        r"ts: shape \(11,\) given, wanted \(10,\)",
    ),
    "clocks": (lambda: plot.speed_profiles([TS, TS], [ONES(11)] * 3), r"ts: 2 given for 3"),
    "NaN among the times": (
        lambda: plot.activations(np.where(TS > 0.5, np.nan, TS), ONES(11)),
        r"ts: every time must be finite",
    ),
    "times of the controls": (
        lambda: plot.controls(TS, ONES((11, 2))),
        r"ts: shape \(11,\) given, wanted \(12,\), one more than `us`",
    ),
    "controls": (
        lambda: plot.controls(TS, ONES((2, 10, 2))),
        r"us: shape \(2, 10, 2\) given, wanted \(T,\) or \(T, nu\)",
    ),
    "a single bound": (lambda: plot.controls(TS, ONES(10), bounds=3.0), r"bounds: a pair"),
    "bounds": (
        lambda: plot.controls(TS, ONES((10, 2)), bounds=(ONES(3), 1.0)),
        r"bounds\[0\]: shape \(3,\) given, wanted \(\) or \(2,\)",
    ),
    "names": (lambda: plot.controls(TS, ONES((10, 2)), names=["a"]), r"names: 1 given, wanted 2"),
    "activations": (
        lambda: plot.activations(TS, np.full(11, np.nan)),
        r"activations: no finite sample",
    ),
    "targets of the trajectories": (
        lambda: plot.trajectories(TS, ONES((11, 2)), unit="rad", targets=ONES(3)),
        r"targets: shape \(3,\) given, wanted \(\) or \(2,\)",
    ),
    "joint angles": (lambda: plot.joint_paths(ONES((11, 3))), r"qs: shape \(11, 3\) given"),
    "joint target": (
        lambda: plot.joint_paths(ONES((11, 2)), target=[np.nan, np.nan]),
        r"target: no finite point",
    ),
    "phase": (lambda: plot.phase(ONES(11)), r"xs: shape \(11,\) given"),
    "cost": (lambda: plot.convergence(ONES((2, 3, 4))), r"cost: shape \(2, 3, 4\) given"),
    "all-NaN cost": (lambda: plot.convergence(NANS), r"cost: no finite sample"),
    "shapes of the curvatures": (
        lambda: plot.speed_and_curvature(TS, ONES((3, 11)), ONES(11)),
        r"curvatures: .*\[\(1, 11\)\], wanted \[\(3, 11\)\], as `speeds`",
    ),
    "times of the curvatures": (
        lambda: plot.speed_and_curvature(TS[:9], ONES(11), ONES(11)),
        r"ts: shape \(9,\) given, wanted \(11,\), as long as `speeds`",
    ),
    "instants": (
        lambda: plot.speed_and_curvature(TS, TS, TS, marks=[0.1, np.nan]),
        r"marks: every time must be finite",
    ),
    "speeds of the power law": (
        lambda: plot.power_law([TS, TS], [TS, TS[:5]]),
        r"speed: .*wanted .* as `radius`",
    ),
    "gain missing": (lambda: plot.power_law(TS, TS, exponent=0.3), r"exponent, gain: both"),
    "exponents": (
        lambda: plot.power_law(TS, TS, exponent=ONES(2), gain=1.0),
        r"exponent: shape \(2,\) given, wanted \(\) or \(1,\)",
    ),
    "nothing positive": (
        lambda: plot.power_law([TS, TS], [TS, -TS]),
        r"radius, speed: entry 1 has no sample where both are positive",
    ),
    "values of a map": (
        lambda: plot.workspace_map(TS, TS[:5], ONES((11, 5)), label="a", unit=""),
        r"values: shape \(11, 5\) given, wanted \(5, 11\), \(ny, nx\)",
    ),
    "grid of a map": (
        lambda: plot.workspace_map(TS[::-1], TS, ONES((11, 11)), label="a", unit=""),
        r"x: at least two positions are wanted, finite and increasing",
    ),
    "points": (lambda: plot.points(ONES((4, 3))), r"points: shape \(4, 3\) given"),
    "points of trials": (lambda: plot.points(ONES((2, 4, 2))), r"points: shape \(2, 4, 2\) given"),
    "number of ellipses": (
        lambda: plot.points([ONES((4, 2))] * 2, ellipses=([0, 0], [1, 1], 0.0)),
        r"ellipses: 1 given, wanted 2",
    ),
    "ellipse": (lambda: plot.points(ONES((4, 2)), ellipses=[1.0]), r"ellipses\[0\]: a tuple"),
    "half axes": (
        lambda: plot.points(ONES((4, 2)), ellipses=([0, 0], [1, -1], 0.0)),
        r"ellipses\[0\]: finite numbers and half axes from 0",
    ),
    "rows": (lambda: plot.panels(0, 2), r"rows, columns: at least 1"),
}


@pytest.mark.parametrize("what", WRONG)
def test_wrong_input_is_named_with_the_shape_wanted(what):
    call, message = WRONG[what]
    with pytest.raises(ValueError, match=message):
        call()


def test_the_arrays_given_are_not_changed():
    path = np.ones((11, 2))
    path[3] = np.inf
    plot.hand_paths(path)
    assert np.isinf(path[3]).all()
