"""One style that leaves no trace: not in the settings, not in pyplot, not in memory."""

import gc
import pickle
import subprocess
import sys
import time
import weakref

import matplotlib
import matplotlib.pyplot
import numpy as np
import pytest
from matplotlib.figure import Figure

from jaxctrl import plot

TS = np.linspace(0.0, 0.5, 26)
REACH = np.stack([TS, 2 * TS], axis=-1)
CALLS = {
    "hand_paths": lambda ax=None: plot.hand_paths([REACH, 2 * REACH], REACH[-1], ax=ax),
    "speed_profiles": lambda ax=None: plot.speed_profiles(TS, [TS, 2 * TS], ax=ax),
    "controls": lambda ax=None: plot.controls(TS, REACH[1:], bounds=(-1.0, 1.5), ax=ax),
    "activations": lambda ax=None: plot.activations(TS, REACH, ax=ax),
    "trajectories": lambda ax=None: plot.trajectories(TS, REACH, unit="rad", ax=ax),
    "joint_paths": lambda ax=None: plot.joint_paths([REACH, 2 * REACH], ax=ax),
    "phase": lambda ax=None: plot.phase([REACH, 2 * REACH], ax=ax),
    "power_law": lambda ax=None: plot.power_law(1 + TS, 1 + TS, exponent=1, gain=1, ax=ax),
    "workspace_map": lambda ax=None: plot.workspace_map(
        TS[:2], TS[:3], REACH[:3], label="gain", unit="", ax=ax
    ),
    "points": lambda ax=None: plot.points(REACH, ellipses=(REACH[3], [0.1, 0.2], 1.0), ax=ax),
    "speed_and_curvature": lambda: plot.speed_and_curvature(TS, TS, TS, marks=0.2),
    "convergence": lambda: plot.convergence([np.exp(-10 * TS), np.exp(-20 * TS)]),
}
INTO_AXES = sorted(set(CALLS) - {"convergence", "speed_and_curvature"})


@pytest.fixture(autouse=True)
def settings_of_the_test():
    with matplotlib.rc_context():
        yield


@pytest.mark.parametrize("name", CALLS)
def test_settings_and_pyplot_are_left_alone(name, tmp_path):
    matplotlib.rcParams["lines.linewidth"] = 7.0
    before = dict(matplotlib.rcParams.copy())
    figure = CALLS[name]()
    figure.savefig(tmp_path / "figure.png")
    with plot.style(dark=True):
        CALLS[name]()
    assert dict(matplotlib.rcParams.copy()) == before
    assert isinstance(figure, Figure) and matplotlib.pyplot.get_fignums() == []


@pytest.mark.parametrize("name", CALLS)
def test_the_users_settings_do_not_change_a_figure(name):
    plain = CALLS[name]()._repr_png_()
    figure = CALLS[name]()
    matplotlib.rcParams.update({"font.size": 20, "xtick.labelsize": 30, "lines.linewidth": 7.0})
    matplotlib.rcParams.update({"xtick.major.size": 20, "savefig.dpi": 10, "figure.dpi": 10})
    assert CALLS[name]()._repr_png_() == plain
    assert figure._repr_png_() == plain


def test_settings_come_back_after_an_error():
    before = dict(matplotlib.rcParams.copy())
    with pytest.raises(RuntimeError), plot.style(dark=True):
        raise RuntimeError
    assert dict(matplotlib.rcParams.copy()) == before
    assert sum(matplotlib.colors.to_rgb(plot.hand_paths(REACH).get_facecolor())) == 3.0


def test_dark_figures_are_light_on_dark_and_stay_so_after_the_block():
    with plot.style(dark=True):
        figure, axes = plot.panels(1, 2)
    plot.hand_paths(REACH, ax=axes[0, 0])
    ax = axes[0, 0]
    assert sum(matplotlib.colors.to_rgb(figure.get_facecolor())) < 0.5
    for color in (ax.xaxis.label.get_color(), ax.get_legend().texts[0].get_color()):
        assert sum(matplotlib.colors.to_rgb(color)) > 2.5


def test_a_change_within_the_style_is_kept():
    with plot.style():
        matplotlib.rcParams["lines.linewidth"] = 3.0
        figure = plot.hand_paths(REACH)
    assert figure.axes[0].lines[0].get_linewidth() == 3.0
    assert plot.hand_paths(REACH).axes[0].lines[0].get_linewidth() < 2.0


def test_every_colour_is_seen_on_its_background():
    def luminance(color):
        rgb = np.array(matplotlib.colors.to_rgb(color))
        linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        return linear @ (0.2126, 0.7152, 0.0722)

    for dark in (False, True):
        with plot.style(dark=dark):
            back = luminance(matplotlib.rcParams["axes.facecolor"])
            colors = matplotlib.rcParams["axes.prop_cycle"].by_key()["color"][:8]
        assert len(set(colors)) == 8
        for color in colors:
            low, high = sorted((luminance(color), back))
            assert (high + 0.05) / (low + 0.05) > 2.0, (dark, color)


@pytest.mark.parametrize("name", INTO_AXES)
def test_an_axes_of_another_figure_is_drawn_into_with_its_own_settings(name):
    matplotlib.rcParams["axes.labelsize"] = 17.0
    figure = Figure()
    ax = figure.subfigures(1, 2)[1].subplots()
    assert CALLS[name](ax=ax) is figure
    assert ax.xaxis.label.get_fontsize() == 17.0


def test_twice_into_one_axes_names_each_mark_once():
    _, axes = plot.panels()
    for factor in (1, 2):
        plot.hand_paths(factor * REACH, [0.5, 1.0], labels=f"{factor}", ax=axes[0, 0])
    names = [text.get_text() for text in axes[0, 0].get_legend().texts]
    assert sorted(names) == ["1", "2", "start", "target"]


@pytest.mark.parametrize("name", CALLS)
def test_pdf_and_png_are_written(name, tmp_path):
    figure = CALLS[name]()
    for suffix, magic in ((".pdf", b"%PDF"), (".png", b"\x89PNG")):
        path = tmp_path / f"figure{suffix}"
        figure.savefig(path)
        assert path.read_bytes().startswith(magic)
    assert b"/Type3" not in (tmp_path / "figure.pdf").read_bytes()


def test_a_notebook_shows_a_figure_without_pyplot():
    formatters = pytest.importorskip("IPython.core.formatters")
    data, _ = formatters.DisplayFormatter().format(plot.hand_paths(REACH))
    assert data["image/png"].startswith(b"\x89PNG")


def test_a_figure_can_be_pickled():
    figure = plot.hand_paths(REACH)
    assert pickle.loads(pickle.dumps(figure))._repr_png_() == figure._repr_png_()


def test_figures_are_freed():
    figures = [weakref.ref(plot.hand_paths(REACH)) for _ in range(20)]
    gc.collect()
    assert not any(figure() for figure in figures)


def test_a_thousand_trials_are_drawn_within_a_few_seconds(tmp_path):
    trials = REACH + 0.01 * np.random.default_rng(0).normal(size=(1000, 26, 2))
    start = time.perf_counter()
    figure = plot.hand_paths(trials, [0.5, 1.0])
    assert time.perf_counter() - start < 2.0
    figure.savefig(tmp_path / "trials.png")
    assert time.perf_counter() - start < 10.0


def test_no_pyplot_and_no_jax_are_imported():
    code = (
        "import sys; from jaxctrl import plot; figure = plot.hand_paths([[0, 0], [1, 1]]);"
        "figure._repr_png_();"
        "assert not {'matplotlib.pyplot', 'jax'} & set(sys.modules), 'imported'"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_colours_of_directions_go_round_and_are_seen_on_white_by_all():
    angles = np.linspace(0, 2 * np.pi, 73)
    colours = plot.direction_colours(angles)
    assert colours.shape == (73, 3) and (colours >= 0).all() and (colours <= 0.8).all()
    # Round without a jump, and the quarters apart in lightness or in blue against the rest.
    assert np.abs(np.diff(np.vstack([colours, colours[:1]]), axis=0)).max() < 0.1
    quarters = plot.direction_colours(np.array([0.0, 0.5, 1.0, 1.5]) * np.pi)
    # Red and green taken together.
    seen = quarters @ np.array([[0.5, 0.0], [0.5, 0.0], [0.0, 1.0]])
    apart = np.linalg.norm(seen[:, None] - seen[None], axis=-1)[np.triu_indices(4, 1)]
    assert apart.min() > 0.2
    with pytest.raises(ValueError, match="angles"):
        plot.direction_colours(np.array([0.0, np.nan]))
