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
