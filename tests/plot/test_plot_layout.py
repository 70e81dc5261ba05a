"""Nothing is cut off, nothing covers the data, and space has one scale."""

import itertools

import numpy as np
import pytest

from jaxctrl import plot

TS = np.linspace(0.0, 0.5, 26)
S = TS / 0.5
LONG = [f"a rather long name {i}" for i in range(6)]
ANGLES = np.arange(8) * np.pi / 4
STAR = [0.1 * S[:, None] * [np.cos(a), np.sin(a)] for a in ANGLES]
MANY = np.linspace(1.0, 2.0, 24) * np.sin(3 * S)[:, None]
ITERATIONS = [np.stack([1 + i * S / 20, 2 - S**2], axis=-1) for i in range(20)]
CLOUD = 10.0 ** np.stack([np.linspace(-2.0, 0.2, 50), np.linspace(-1.0, -0.3, 50)])
MAP = np.where(np.arange(20) > 3, np.arange(20.0), np.nan).reshape(4, 5)

FIGURES = {
    "star": lambda: plot.hand_paths(STAR, [path[-1] for path in STAR], labels=list("abcdefgh")),
    "vertical": lambda: plot.hand_paths(np.stack([0 * S, 0.1 * S], axis=-1), [0.0, 0.1]),
    "horizontal": lambda: plot.hand_paths(np.stack([0.6 * S, 0 * S], axis=-1), [0.6, 0.0]),
    "narrow": lambda: plot.hand_paths(
        np.stack([0.1 * S, 0.05 * S], axis=-1), [0.1, 0.05], labels="a rather long name indeed"
    ),
    "point": lambda: plot.hand_paths(np.full((3, 2), 0.2)),
    "trials": lambda: plot.hand_paths(np.stack(STAR)),
    "speeds": lambda: plot.speed_profiles(TS, [S, S**2], labels=LONG[:2]),
    "controls": lambda: plot.controls(TS, MANY[1:, :6], names=LONG, bounds=(0.0, 3.0)),
    "activations": lambda: plot.activations(TS, MANY),
    "trajectories": lambda: plot.trajectories(TS, MANY[:, :3], unit="rad/s", targets=1.0),
    "joints": lambda: plot.joint_paths(ITERATIONS[:3], target=[1.5, 1.0], labels=LONG[:3]),
    "iterations": lambda: plot.joint_paths(ITERATIONS, target=[1.5, 1.0]),
    "phase": lambda: plot.phase([10 * path for path in ITERATIONS], target=[np.pi, 0.0]),
    "convergence": lambda: plot.convergence(
        np.exp(-20 * MANY.T[:4]), gradient=np.exp(-9 * MANY.T[:4]), labels=LONG[:4]
    ),
    "lanes": lambda: plot.convergence(np.exp(-20 * MANY.T)),
}
FIGURES |= {
    "obstacles": lambda: plot.hand_paths(
        STAR[0], [0.1, 0.0], via=[[0.03, 0.04], [0.0, -0.05]], obstacles=[0.12, 0.06, 0.03]
    ),
    "speed and curvature": lambda: plot.speed_and_curvature(
        TS, MANY.T[:2], 1 / (0.1 + MANY.T[:2] ** 2), marks=[0.1, 0.2]
    ),
    "power law": lambda: plot.power_law(
        [CLOUD[0], CLOUD[0] ** 2 + 0.001],
        [CLOUD[1], 2 * CLOUD[1]],
        exponent=1 / 3,
        gain=[0.5, 1.0],
        labels=["slow", "fast"],
    ),
    "power law within a decade": lambda: plot.power_law(CLOUD[1], CLOUD[1]),
    "power law over many decades": lambda: plot.power_law(CLOUD[0] ** 8, CLOUD[1] ** 2),
    "map": lambda: plot.workspace_map(
        0.7 * np.cos(ANGLES[4::-1]), ANGLES[:4] / 4, MAP, label="gain", unit=""
    ),
    "signed map": lambda: plot.workspace_map(
        0.01 * ANGLES[:5], 0.02 * ANGLES[:4], MAP - 9, label="torque", unit="N m", diverging=True
    ),
    "points": lambda: plot.points(
        [path[9:12] for path in STAR[:3]],
        ellipses=[(path[10], [0.02, 0.01], a) for path, a in zip(STAR[:3], ANGLES, strict=False)],
        targets=[path[-1] for path in STAR[:3]],
        labels=LONG[:3],
    ),
}


def four_panels():
    figure, axes = plot.panels(2, 2)
    plot.hand_paths(STAR, labels=list("abcdefgh"), ax=axes[0, 0])
    plot.speed_profiles(TS, S, ax=axes[0, 1])
    plot.controls(TS, MANY[1:, :6], names=LONG, ax=axes[1, 0])
    plot.joint_paths(ITERATIONS, ax=axes[1, 1])
    return figure


FIGURES["panels"] = four_panels


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("name", FIGURES)
def test_the_legend_is_outside_the_axes_and_inside_the_figure(name, dark):
    with plot.style(dark=dark):
        figure = FIGURES[name]()
    figure.draw_without_rendering()
    for ax in figure.axes:
        if ax.get_legend() is None:
            continue
        box = ax.get_legend().get_window_extent()
        for other in figure.axes:
            assert not box.overlaps(other.get_window_extent())
        assert figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= box.y0 and box.y1 <= figure.bbox.y1


@pytest.mark.parametrize("name", FIGURES)
def test_nothing_is_cut_off_at_the_edge_of_the_figure(name):
    figure = FIGURES[name]()
    figure.draw_without_rendering()
    box, whole = figure.get_tightbbox(), figure.bbox_inches
    assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= whole.x1 and box.y1 <= whole.y1
    for ax in figure.axes:
        assert ax.get_window_extent().width > 0.3 * figure.bbox.width / len(figure.axes) ** 0.5


@pytest.mark.parametrize("name", FIGURES)
def test_tick_labels_do_not_overlap(name):
    figure = FIGURES[name]()
    figure.draw_without_rendering()
    with figure.in_its_style():
        for ax in figure.axes:
            for axis, start, stop in ((ax.xaxis, "x0", "x1"), (ax.yaxis, "y0", "y1")):
                low, high = sorted(axis.get_view_interval())
                boxes = [
                    tick.label1.get_window_extent()
                    for tick in axis.get_major_ticks()
                    if low <= tick.get_loc() <= high and tick.label1.get_visible()
                ]
                ends = sorted((getattr(b, start), getattr(b, stop)) for b in boxes if b.width > 1)
                assert all(a[1] <= b[0] for a, b in itertools.pairwise(ends))


@pytest.mark.parametrize(
    "name",
    [
        *("star", "vertical", "horizontal", "point", "trials", "joints", "iterations"),
        *("obstacles", "map", "signed map", "points"),
    ],
)
def test_paths_have_equal_aspect(name):
    figure = FIGURES[name]()
    figure.draw_without_rendering()
    origin, across, up = figure.axes[0].transData.transform([(0, 0), (1, 0), (0, 1)])
    # matplotlib leaves the limits alone within half a percent
    assert across[0] - origin[0] == pytest.approx(up[1] - origin[1], rel=0.006)


@pytest.mark.parametrize(
    "name",
    ["star", "vertical", "horizontal", "narrow", "phase", "joints", "obstacles", "points"],
)
def test_marks_are_not_cut_by_the_axes(name):
    figure = FIGURES[name]()
    figure.draw_without_rendering()
    ax = figure.axes[0]
    box = ax.get_window_extent()
    for line in ax.lines:
        if line.get_marker() not in ("o", "s", "x"):
            continue
        radius = 0.5 * line.get_markersize() * figure.dpi / 72
        places = ax.transData.transform(line.get_xydata())
        assert (places >= box.min + radius).all() and (places <= box.max - radius).all()


def test_every_axis_carries_its_unit():
    for name, make in FIGURES.items():
        for ax in make().axes:
            for label in (ax.get_xlabel(), ax.get_ylabel()):
                named = "[" in label or label in ("", "iteration", "path")
                assert named, (name, label)


def test_fonts_can_be_read_in_a_journal_column():
    for make in FIGURES.values():
        figure = make()
        for ax in figure.axes:
            texts = [ax.xaxis.label, ax.yaxis.label, *ax.get_xticklabels(), *ax.get_yticklabels()]
            texts += ax.get_legend().texts if ax.get_legend() else []
            assert min(text.get_fontsize() for text in texts) >= 7
