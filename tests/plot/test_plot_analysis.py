"""Figures of analysed movements: what is drawn is what was given, obstacles and maps included."""

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.collections import QuadMesh
from matplotlib.colors import to_hex
from matplotlib.patches import Circle, Ellipse

from jaxctrl import plot

RNG = np.random.default_rng(0)
TS = np.linspace(0.0, 0.5, 26)
REACH = np.stack([0.1 * TS / 0.5, 0.3 + 0.08 * (TS / 0.5) ** 2], axis=-1)
RADIUS = np.exp(RNG.normal(-2.0, 0.5, 400))
SPEED = 0.5 * RADIUS**0.3


def named(ax, label):
    """Return the line with a label."""
    (line,) = [line for line in ax.lines if line.get_label() == label]
    return line


def entries(ax):
    return [text.get_text() for text in ax.get_legend().texts]


@pytest.mark.parametrize("convert", [np.asarray, jnp.asarray, lambda a: a.tolist()])
def test_via_points_are_crosses_and_obstacles_discs_to_scale(convert):
    via = np.array([[0.02, 0.31], [0.05, 0.32]])
    discs = np.array([[0.05, 0.35, 0.02], [0.2, 0.2, 0.03]])
    ax = plot.hand_paths(REACH, via=convert(via), obstacles=convert(discs)).axes[0]
    crosses = named(ax, "via-point")
    np.testing.assert_allclose(crosses.get_xydata(), 100 * via)
    assert crosses.get_marker() == "x" and crosses.get_linestyle() == "None"
    circles = [patch for patch in ax.patches if isinstance(patch, Circle)]
    drawn = [(*circle.center, circle.radius) for circle in circles]
    np.testing.assert_allclose(drawn, 100 * discs)
    assert all(circle.get_zorder() < 2 for circle in circles)  # beneath the paths
    assert entries(ax) == ["obstacle", "start", "via-point"]


def test_an_obstacle_widens_the_limits_and_tells_the_unit():
    ax = plot.hand_paths(REACH, obstacles=[0.2, 0.2, 0.03]).axes[0]
    low, high = ax.viewLim.get_points()
    assert low[1] < 17.0 and high[0] > 23.0
    ax = plot.hand_paths(REACH, obstacles=[0.0, 0.0, 0.5]).axes[0]
    assert ax.get_xlabel() == "x [m]" and ax.viewLim.x0 < -0.5


def test_a_hand_path_alone_has_neither_crosses_nor_discs():
    ax = plot.hand_paths(REACH, via=[], obstacles=None).axes[0]
    assert not ax.patches and entries(ax) == ["start"]


def test_speed_and_curvature_share_time_colours_and_marks():
    curvature = 20 + 10 * np.sin(9 * TS)
    curvature[:4] = np.nan
    figure = plot.speed_and_curvature(
        [TS, TS[:9]], [TS, TS[:9] ** 2], [curvature, curvature[:9]], labels=["a", "b"], marks=0.3
    )
    top, bottom = figure.axes
    for ax, values in ((top, (TS, TS[:9] ** 2)), (bottom, (curvature, curvature[:9]))):
        for label, value in zip("ab", values, strict=True):
            np.testing.assert_array_equal(named(ax, label).get_ydata(), value)
            np.testing.assert_array_equal(named(ax, label).get_xdata(), TS[: len(value)])
        (mark,) = [line for line in ax.lines if len(line.get_xdata()) == 2]
        assert list(mark.get_xdata()) == [0.3, 0.3]
        assert mark.get_linewidth() < named(ax, "a").get_linewidth()
        assert ax.get_ylim()[0] == 0
    assert [line.get_color() for line in top.lines] == [line.get_color() for line in bottom.lines]
    assert top.get_xlim() == bottom.get_xlim() and entries(top) == ["a", "b"]
    assert [ax.get_ylabel() for ax in figure.axes] == ["hand speed [m/s]", "curvature [1/m]"]
    assert bottom.get_xlabel() == "time [s]" and top.get_xlabel() == ""


def test_a_power_law_is_a_line_over_the_range_of_its_samples():
    speed = SPEED.copy()
    speed[:3] = np.nan, 0.0, -1.0
    ax = plot.power_law(RADIUS, speed, exponent=0.3, gain=0.5).axes[0]
    assert ax.get_xscale() == ax.get_yscale() == "log"
    samples, line = ax.lines[0], ax.lines[-1]
    np.testing.assert_array_equal(samples.get_xydata(), np.stack([RADIUS, SPEED], axis=1)[3:])
    ends = np.array([RADIUS[3:].min(), RADIUS[3:].max()])
    np.testing.assert_allclose(line.get_xydata(), np.stack([ends, 0.5 * ends**0.3], axis=1))
    assert entries(ax) == ["samples", r"$v = 0.5\,r^{\,0.30}$"]
    units = [label.split("[")[-1] for label in (ax.get_xlabel(), ax.get_ylabel())]
    assert units == ["m]", "m/s]"]


def test_many_samples_are_small_transparent_and_do_not_fill_a_file():
    radius, speed = (np.tile(array, 30) for array in (RADIUS, SPEED))
    few, many = plot.power_law(RADIUS, SPEED).axes[0], plot.power_law(radius, speed).axes[0]
    assert many.lines[0].get_alpha() < few.lines[0].get_alpha() < 1.0
    assert many.lines[0].get_markersize() <= few.lines[0].get_markersize() < 3.0
    assert many.lines[0].get_rasterized() and not few.lines[0].get_rasterized()


def test_each_entry_of_a_power_law_has_its_colour_and_its_line():
    ax = plot.power_law(
        [RADIUS, RADIUS.reshape(4, 100)],
        [SPEED, 2 * SPEED.reshape(4, 100)],
        exponent=0.3,
        gain=[0.5, np.nan],
        labels=["slow", "fast"],
    ).axes[0]
    assert entries(ax) == ["slow", r"$v = 0.5\,r^{\,0.30}$", "fast"]
    np.testing.assert_array_equal(named(ax, "slow").get_markersize(), 4)
    assert named(ax, "slow").get_color() != named(ax, "fast").get_color()
    assert len([line for line in ax.lines if len(line.get_xdata()) == 400]) == 2


def test_a_map_puts_every_value_at_its_place():
    x, y = np.linspace(-0.6, 0.6, 7), np.linspace(0.0, 0.8, 5)
    values = RNG.normal(size=(5, 7))
    values[0, 0], values[2, 3] = np.nan, np.inf
    (ax,) = plot.workspace_map(x, y, values, label="gain", unit="N m").axes
    (mesh,) = [c for c in ax.collections if isinstance(c, QuadMesh)]
    corners = mesh.get_coordinates()
    centres = (corners[1:, 1:] + corners[:-1, :-1]) / 2
    np.testing.assert_allclose(centres, np.stack(np.meshgrid(x, y), axis=-1), atol=1e-12)
    drawn = np.ma.masked_array(mesh.get_array())
    np.testing.assert_array_equal(drawn.mask.reshape(5, 7), ~np.isfinite(values))
    np.testing.assert_array_equal(drawn.compressed(), values[np.isfinite(values)])
    (bar,) = ax.child_axes
    assert bar.get_xlabel() == "gain [N m]" and ax.get_xlabel() == "x [m]"
    grey = mesh.get_cmap().get_bad()
    assert grey[3] == 1.0 and len(set(grey[:3])) == 1 and grey[0] < 0.9


def test_a_signed_map_is_white_at_zero():
    for values in (np.array([[-1.0, 3.0], [np.nan, 0.5]]), np.zeros((2, 2))):
        ax = plot.workspace_map([0, 1], [0, 1], values, label="a", unit="m", diverging=True).axes[0]
        (mesh,) = [c for c in ax.collections if isinstance(c, QuadMesh)]
        low, high = mesh.get_clim()
        assert low == -high == -(np.nanmax(abs(values)) or 1.0)
        assert min(mesh.to_rgba(0.0)[:3]) > 0.95


def test_paths_are_drawn_over_a_map_in_its_unit():
    figure, axes = plot.panels()
    ax = axes[0, 0]
    plot.workspace_map([-0.6, 0.0, 0.6], [0.0, 0.6], np.ones((2, 3)), label="a", unit="m", ax=ax)
    plot.hand_paths(REACH, REACH[-1], ax=ax)
    np.testing.assert_allclose(named(ax, "target").get_xydata(), REACH[-1:])
    figure.draw_without_rendering()
    assert not ax.get_legend().get_window_extent().overlaps(ax.child_axes[0].get_tightbbox())


def test_points_and_their_ellipses_have_one_colour_and_true_size():
    groups = [REACH, 1.5 * REACH]
    rims = [(REACH[3], [0.02, 0.01], 0.5), (1.5 * REACH[9], jnp.array([0.03, 0.0]), -1.0)]
    ax = plot.points(groups, ellipses=rims, targets=REACH[-1], labels=["a", "b"]).axes[0]
    clouds = [line for line in ax.lines if len(line.get_xdata()) == 26]
    for line, rim, group, (centre, half, angle) in zip(
        clouds, ax.patches, groups, rims, strict=True
    ):
        assert isinstance(rim, Ellipse)
        np.testing.assert_allclose(line.get_xydata(), 100 * group)
        np.testing.assert_allclose(rim.get_center(), 100 * centre)
        np.testing.assert_allclose([rim.width, rim.height], 200 * np.asarray(half))
        assert rim.angle == pytest.approx(np.degrees(angle))
    assert [to_hex(rim.get_edgecolor()) for rim in ax.patches] == ["#0072b2", "#d55e00"]
    np.testing.assert_allclose(named(ax, "target").get_xydata(), 100 * REACH[-1:])
    assert entries(ax) == ["a", "b", "target"]


def test_an_ellipse_widens_the_limits():
    ax = plot.points(REACH, ellipses=([0.05, 0.34], [0.2, 0.01], np.pi / 2)).axes[0]
    assert ax.viewLim.y0 < 14.0 and ax.viewLim.y1 > 54.0
    assert ax.get_legend() is None
