"""What is drawn is what was given: samples, gaps, units, marks, one curve for each thing."""

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex

from jaxctrl import plot

RNG = np.random.default_rng(0)
TS = np.linspace(0.0, 0.5, 26)
REACH = np.stack([0.1 * TS / 0.5, 0.3 + 0.08 * (TS / 0.5) ** 2], axis=-1)


def curves(ax):
    """Return the data of the lines drawn without markers, longer than two points."""
    lines = [line for line in ax.lines if line.get_marker() in ("None", "", None)]
    return [np.column_stack(line.get_data()) for line in lines if len(line.get_xdata()) > 2]


def named(ax, label):
    """Return the data (n, 2) of the line with a label."""
    (line,) = [line for line in ax.lines if line.get_label() == label]
    return np.column_stack(line.get_data())


def units(ax):
    return [ax.get_xlabel().split("[")[-1], ax.get_ylabel().split("[")[-1]]


@pytest.mark.parametrize("convert", [np.asarray, jnp.asarray, lambda a: a.tolist()])
def test_a_hand_path_is_drawn_in_centimetres_at_its_own_samples(convert):
    ax = plot.hand_paths(convert(REACH), convert(REACH[-1])).axes[0]
    (drawn,) = curves(ax)
    np.testing.assert_allclose(drawn, 100 * REACH)
    assert units(ax) == ["cm]", "cm]"]


def test_a_hand_path_of_more_than_half_a_metre_is_drawn_in_metres():
    ax = plot.hand_paths(8 * REACH).axes[0]
    np.testing.assert_allclose(curves(ax)[0], 8 * REACH)
    assert units(ax) == ["m]", "m]"]


def test_a_second_hand_path_keeps_the_unit_of_the_axes():
    figure, axes = plot.panels()
    for scale in (1, 8):
        assert plot.hand_paths(scale * REACH, ax=axes[0, 0]) is figure
    np.testing.assert_allclose(curves(axes[0, 0])[1], 800 * REACH)
    colors = {line.get_color() for line in axes[0, 0].lines if len(line.get_xdata()) > 2}
    assert len(colors) == 2


def test_starts_are_the_first_samples_and_targets_as_given():
    targets = np.array([[0.1, 0.38], [0.0, 0.2]])
    ax = plot.hand_paths([REACH, REACH * [-1, 1]], targets).axes[0]
    np.testing.assert_allclose(named(ax, "start"), 100 * REACH[:1])
    np.testing.assert_allclose(named(ax, "target"), 100 * targets)
    ax = plot.hand_paths(REACH, starts=[]).axes[0]
    assert "start" not in [line.get_label() for line in ax.lines]
    ax = plot.hand_paths(REACH, starts=targets).axes[0]
    np.testing.assert_allclose(named(ax, "start"), 100 * targets)


def test_many_trials_are_drawn_thin_and_transparent_under_their_mean():
    trials = REACH + 0.01 * RNG.normal(size=(1000, 26, 2))
    ax = plot.hand_paths(trials).axes[0]
    (bundle,) = [c for c in ax.collections if isinstance(c, LineCollection)]
    np.testing.assert_allclose(bundle.get_segments(), 100 * trials)
    np.testing.assert_allclose(named(ax, "mean"), 100 * trials.mean(axis=0))
    (mean,) = [line for line in ax.lines if line.get_label() == "mean"]
    assert mean.get_zorder() > bundle.get_zorder()
    assert bundle.get_alpha() < 0.5 and bundle.get_linewidth()[0] < mean.get_linewidth()
    low, high = ax.viewLim.get_points()
    assert (low < 100 * trials.min((0, 1))).all() and (high > 100 * trials.max((0, 1))).all()


def test_eight_directions_have_eight_colours_and_their_labels():
    angles = np.arange(8) * np.pi / 4
    paths = [TS[:, None] * [np.cos(a), np.sin(a)] + np.zeros((20, 1, 1)) for a in angles]
    labels = [f"{45 * i}°" for i in range(8)]
    ax = plot.hand_paths(paths, labels=labels).axes[0]
    lines = [line for line in ax.lines if line.get_label() in labels]
    assert len({line.get_color() for line in lines}) == 8
    assert [text.get_text() for text in ax.get_legend().texts] == [*labels, "start"]


def test_samples_that_are_not_finite_are_gaps():
    path = REACH.copy()
    path[5], path[9, 0] = np.nan, np.inf
    trials = np.stack([path, REACH])
    drawn = named(plot.hand_paths(path, labels="path").axes[0], "path")
    np.testing.assert_array_equal(np.isnan(drawn).any(axis=1), np.isin(np.arange(26), [5, 9]))
    np.testing.assert_allclose(named(plot.hand_paths(trials).axes[0], "mean"), 100 * REACH)


def test_speeds_are_drawn_in_metres_per_second_from_zero():
    speeds = 0.3 * np.sin(np.pi * TS / 0.5) + 0.05 * RNG.random((7, 26))
    ax = plot.speed_profiles(TS, speeds).axes[0]
    np.testing.assert_allclose(named(ax, "mean")[:, 1], speeds.mean(axis=0))
    assert units(ax) == ["s]", "m/s]"] and ax.get_ylim()[0] == 0
    ax = plot.speed_profiles([TS, 2 * TS[:9]], [speeds[0], speeds[1, :9]]).axes[0]
    np.testing.assert_allclose(named(ax, "2"), np.stack([2 * TS[:9], speeds[1, :9]], axis=-1))


def test_controls_are_steps_between_the_instants():
    us = RNG.normal(size=(25, 3))
    ax = plot.controls(TS, us, unit="N m", names=["a", "b", "c"]).axes[0]
    assert len(ax.patches) == 3
    for steps, values in zip(ax.patches, us.T, strict=True):
        np.testing.assert_allclose(steps.get_data().values, values)
        np.testing.assert_allclose(steps.get_data().edges, TS)
    assert units(ax) == ["s]", "N m]"]


def test_bounds_are_thin_lines_unless_they_would_flatten_the_controls():
    us = np.linspace([0.0, -1.0], [1.0, 1.0], 25)
    thick = plot.controls(TS, us).axes[0].patches[0].get_linewidth()

    def levels(bounds):
        lines = plot.controls(TS, us, bounds=bounds).axes[0].lines
        assert all(line.get_linewidth() < thick for line in lines)
        return sorted(float(line.get_ydata()[0]) for line in lines if len(line.get_ydata()))

    assert levels((-1.5, 2.0)) == [-1.5, 2.0]
    assert levels(([-1.5, -1.2], jnp.array([1.2, 2.0]))) == [-1.5, -1.2, 1.2, 2.0]
    assert levels((-np.inf, [2.0, np.inf])) == [2.0]
    assert levels((-1e3, 1.5)) == [1.5]


def test_activations_and_trajectories_are_one_curve_for_each_column():
    values = RNG.random((26, 9))
    ax = plot.activations(TS, values).axes[0]
    for drawn, column in zip(curves(ax), values.T, strict=True):
        np.testing.assert_allclose(drawn, np.stack([TS, column], axis=-1))
    looks = {(line.get_color(), line.get_linestyle()) for line in ax.lines}
    assert len(looks) == 9 and units(ax) == ["s]", "–]"]
    ax = plot.trajectories(TS, values[:, :2], unit="rad", targets=[0.4, 0.6]).axes[0]
    np.testing.assert_allclose(curves(ax)[1][:, 1], values[:, 1])
    dashed = [line for line in ax.lines if line.get_linestyle() == "--" and len(line.get_ydata())]
    assert [line.get_ydata()[0] for line in dashed] == [0.4, 0.6]
    colors = [to_hex(line.get_color()) for line in (*dashed, *ax.lines[:2])]
    assert colors[:2] == colors[2:]
    assert ax.get_ylabel() == "angle [rad]"


def test_joint_paths_and_phase_mark_start_end_and_target():
    paths = [REACH, 2 * REACH]
    for ax, wanted in (
        (plot.joint_paths(paths, target=[0.1, 0.4]).axes[0], ["rad]", "rad]"]),
        (plot.phase(np.stack(paths), target=[0.1, 0.4]).axes[0], ["rad]", "rad/s]"]),
    ):
        np.testing.assert_allclose(curves(ax), paths)
        np.testing.assert_allclose(named(ax, "start"), [REACH[0], 2 * REACH[0]])
        np.testing.assert_allclose(named(ax, "end"), [REACH[-1], 2 * REACH[-1]])
        np.testing.assert_allclose(named(ax, "target"), [[0.1, 0.4]])
        assert units(ax) == wanted


def test_many_iterations_take_a_sequence_of_colours_with_a_bar():
    paths = [REACH * (1 + i / 20) for i in range(20)]
    (ax,) = plot.joint_paths(paths).axes
    (bar,) = ax.child_axes
    assert bar.get_xlabel() == "iteration"
    colors = [tuple(line.get_color()) for line in ax.lines if line.get_marker() == "None"]
    assert len(set(colors)) == 20
    np.testing.assert_allclose(named(ax, "end"), paths[-1][-1:])
    assert not plot.joint_paths(paths, labels=list("abcdefghijklmnopqrst")).axes[0].child_axes


def test_a_pendulum_that_turns_has_ticks_at_multiples_of_pi():
    figure = plot.phase(np.linspace([-np.pi, 0.0], [np.pi, 3.0], 50))
    figure.draw_without_rendering()
    names = [label.get_text() for label in figure.axes[0].get_xticklabels()]
    assert {"−π", "−π/2", "0", "π/2", "π"} <= set(names)


def test_trajectories_that_lie_across_are_named_with_advice():
    ts = np.linspace(0, 1, 11)
    with pytest.raises(ValueError, match=r"^values: shape \(2, 11\) .* \(11, n\).*try \.T"):
        plot.trajectories(ts, np.ones((2, 11)), unit="rad")
    with pytest.raises(ValueError, match=r"^ts: shape"):
        plot.trajectories(ts, np.ones((12, 2)), unit="rad")
