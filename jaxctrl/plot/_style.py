"""The one style of every figure, and the figures and Axes that are drawn in it.

Figures are made without pyplot: nothing is registered, no window or backend is touched, and a
thousand of them are freed like any other object. A figure remembers the style it was made in and
is drawn and saved in it, whatever the global settings are by then.
"""

import contextlib
import io
from collections.abc import Iterator
from contextvars import ContextVar
from functools import lru_cache
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

COLUMN = 3.5
"""Width of a journal column [inch]."""

_active: ContextVar[bool] = ContextVar("jaxctrl_plot_style_active", default=False)

# Settings of the application rather than of a figure: matplotlib refuses them in a style.
_NOT_STYLE = (
    *("backend", "interactive", "toolbar", "timezone", "webagg.", "tk.", "date.epoch"),
    *("docstring.", "savefig.directory", "figure.max_open_warning", "figure.raise_window"),
)


@lru_cache
def _sheet(dark: bool) -> Any:
    """Read a style sheet once."""
    path = Path(__file__).with_name("dark.mplstyle" if dark else "light.mplstyle")
    return matplotlib.rc_params_from_file(path, use_default_template=False)


@contextlib.contextmanager
def style(dark: bool = False) -> Iterator[None]:
    """Draw in the style of jaxctrl inside a `with` block, light or dark.

    Every function of `jaxctrl.plot` draws in the light style by itself; this is for dark figures,
    for other plots that should look the same, and for adjustments:

        with jc.plot.style(dark=True):
            matplotlib.rcParams["font.size"] = 10
            figure = jc.plot.hand_paths(paths, target)

    On leaving, matplotlib's settings are those from before.

    Arguments:
        dark: near-black background instead of white.
    """
    with matplotlib.style.context(["default", _sheet(bool(dark))]):
        token = _active.set(True)
        try:
            yield
        finally:
            _active.reset(token)


def _settings() -> dict[str, Any]:
    """Return the present settings that differ from matplotlib's own."""
    default = dict(matplotlib.rcParamsDefault.copy())
    now = dict(matplotlib.rcParams.copy())
    return {
        key: value
        for key, value in now.items()
        if not key.startswith(_NOT_STYLE) and value != default.get(key)
    }


class StyledFigure(Figure):
    """A matplotlib Figure that is drawn, saved and shown in the style in which it was made.

    A notebook shows a bare Figure only once pyplot has been imported; this one always.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        """Make an empty figure in the present settings; arguments as of `Figure`."""
        super().__init__(*args, **kwargs)
        self._settings = _settings()

    def in_its_style(self) -> contextlib.AbstractContextManager[None]:
        """Return a context with the settings in which the figure was made."""
        return matplotlib.style.context(["default", self._settings])

    def draw(self, renderer: Any) -> None:
        """Draw in the figure's own style: ticks and fonts read the settings only now."""
        # The font type of a PDF must stay one from the opening to the closing of the file.
        kept: Any = {key: matplotlib.rcParams[key] for key in ("pdf.fonttype", "ps.fonttype")}
        with self.in_its_style(), matplotlib.rc_context(kept):
            self._settle()
            super().draw(renderer)

    def _settle(self) -> None:
        """Lay out until nothing moves.

        The layout depends on the tick labels and on the aspect, and they on the layout, so that
        the single pass of matplotlib may leave a label or a legend cut. Where two layouts follow
        each other for ever, wider margins hold both.
        """
        layout = self.get_layout_engine()
        if not isinstance(layout, ConstrainedLayoutEngine) or not self.axes:
            return
        for attempt in range(12):
            before = [ax.get_position(original=True).bounds for ax in self.axes]
            layout.execute(self)
            after = [ax.get_position(original=True).bounds for ax in self.axes]
            if np.allclose(before, after, rtol=0, atol=1e-3):
                return
            if attempt == 8:
                layout.set(w_pad=0.12, h_pad=0.08)

    def get_tightbbox(self, *args: Any, **kwargs: Any) -> Any:
        """Return the box of all that is drawn [inch]; arguments as of `Figure.get_tightbbox`."""
        with self.in_its_style():
            return super().get_tightbbox(*args, **kwargs)

    def savefig(self, fname: Any, **kwargs: Any) -> None:
        """Save in the figure's own style; arguments as of `Figure.savefig`."""
        with self.in_its_style():
            super().savefig(fname, **kwargs)

    def _repr_png_(self) -> bytes:
        """Return the figure as PNG bytes, for notebooks."""
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", dpi="figure")
        return buffer.getvalue()


def panels(
    rows: int = 1,
    columns: int = 1,
    *,
    size: tuple[float, float] | None = None,
    sharex: bool = False,
) -> tuple[Figure, np.ndarray]:
    """Make a figure of several Axes, each to be handed to a function of `jaxctrl.plot` as `ax`.

    Arguments:
        rows, columns: number of Axes down and across.
        size: width and height in inches; by default 3.5 (a journal column) by 2.2 for one Axes,
            and as much for each further row and column, up to a page of 7.2.
        sharex: whether the Axes of a column share their horizontal axis.
    Returns: the Figure, and its Axes as an object array (rows, columns).
    """
    if rows < 1 or columns < 1:
        raise ValueError(f"rows, columns: at least 1 is wanted, got {rows}, {columns}")
    if size is None:
        size = (min(7.2, COLUMN * columns), 2.2 * rows)
    with contextlib.nullcontext() if _active.get() else style():
        figure = StyledFigure(figsize=size)
        axes = figure.subplots(rows, columns, squeeze=False, sharex=sharex)
    return figure, axes


@contextlib.contextmanager
def drawing(ax: Axes | None, size: tuple[float, float]) -> Iterator[Axes]:
    """Give the Axes to draw in, inside the style of its figure.

    A new Axes is made when `ax` is None. An Axes of somebody else's figure is drawn in as it is:
    the present settings and its own colours.
    """
    if ax is None:
        ax = panels(size=size)[1][0, 0]
    assert ax is not None
    figure = figure_of(ax)
    if isinstance(figure, StyledFigure):
        with figure.in_its_style():
            yield ax
    else:
        yield ax


def figure_of(ax: Axes) -> Figure:
    """Return the whole figure that holds `ax`, also from within a subfigure."""
    figure: Any = ax.figure
    while not isinstance(figure, Figure):
        figure = figure.figure
    return figure


def direction_colours(angles: Any) -> np.ndarray:
    """Return a colour for each direction: near directions have near colours, all the way round.

    ax.set_prop_cycle(color=direction_colours(angles)) before drawing paths or speeds into `ax`.

    The colours go from grey at 0 over blue, black at pi and red back to grey, which most
    colour-blind eyes tell apart too: matplotlib's map "twilight", darkened to be seen on white.

    Arguments:
        angles: directions [rad], (n,).
    Returns: red, green, blue between 0 and 1, (n, 3).
    Raises: ValueError for another shape, or an angle that is not finite.
    """
    angles = np.asarray(angles, float)
    if angles.ndim != 1 or not np.isfinite(angles).all():
        raise ValueError(f"angles: finite numbers of shape (n,) are wanted, got {angles!r:.60}")
    turns = np.mod(angles / (2 * np.pi), 1.0)
    return 0.8 * matplotlib.colormaps["twilight"](turns)[:, :3]
