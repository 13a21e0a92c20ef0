"""Pictures of an estimate, each one PNG. Needs matplotlib: pip install 'r2s[study]'.

Each function returns `path`, and raises OSError that names it when it cannot be written.
"""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Array, Float, Integer

from r2s.fabrics.parameters import Range
from r2s.files import write_bytes

try:
    # The object API alone: pyplot would keep every figure, and choose a backend for the caller.
    from matplotlib.colors import to_rgba
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection
except ImportError as error:
    raise ImportError("figures need matplotlib: pip install 'r2s[study]'") from error

# Okabe and Ito's colours, which the colour-blind can tell apart.
BLUE, ORANGE, SKY, VERMILION, GREY = "#0072B2", "#E69F00", "#56B4E9", "#D55E00", "#8c8c8c"
BAR_COLOURS = (BLUE, ORANGE, SKY, GREY, VERMILION)
# One a column of the study, which keeps its own in every picture: Okabe and Ito's, and then darker.
LABEL_COLOURS = (BLUE, ORANGE, "#009E73", VERMILION, SKY, "#CC79A7", "#B8A800", "#5D3A9B",
                 "#994F00", "#006CD1", "#40B0A6", GREY)  # fmt: skip
MOST_DOTS = 1500  # a panel; more would hide the cloth


def overlay(
    path: Path | str,
    clouds: Sequence[Float[Array | np.ndarray, "_ 3"]],
    before: Float[Array | np.ndarray, "frame vertex 3"],
    after: Float[Array | np.ndarray, "frame vertex 3"],
    faces: Integer[Array | np.ndarray, "face 3"],
    times: Float[Array | np.ndarray, " frame"],
    title: str,
) -> Path:
    """The cloud of each frame over the cloth of the default fabric (above) and of the estimate.

    `clouds` [m]: one per frame; `before`, `after` [m]: the vertices with the default fabric and
    with the estimate; `times` [s]. About five frames fit. All panels share their limits, which
    outliers of the clouds and a cloth that flew off do not widen; what lies outside is left out.
    Raises ValueError unless there is one cloud per frame.
    """
    cloths, count = [np.asarray(before), np.asarray(after)], len(times)
    if len(clouds) != count:
        raise ValueError(f"expected one cloud per frame, found {len(clouds)} for {count}")
    dots = [thin(np.asarray(cloud)) for cloud in clouds]
    box = limits(np.concatenate(dots), np.concatenate(cloths).reshape(-1, 3))
    figure = Figure(figsize=(3.1 * count, 6.2))
    figure.subplots_adjust(left=0.02, right=0.98, bottom=0.03, top=0.91, wspace=0.1, hspace=0.1)
    view = {"projection": "3d", "elev": 15, "azim": -60}
    panels = figure.subplots(2, count, subplot_kw=view, squeeze=False)
    for row, cloth in zip(panels, cloths, strict=True):
        for i, axes in enumerate(row):
            _draw(axes, dots[i], cloth[i], np.asarray(faces), *box)
            axes.set_title(f"{float(times[i]):.2f} s", fontsize=11, y=1.0)
    for height, text in ((0.7, "before: default fabric"), (0.25, "after: estimate")):
        figure.text(0.006, height, text, rotation=90, va="center", fontsize=12)
    figure.suptitle(title, fontsize=13)
    return save(figure, path)


def traces(
    path: Path | str,
    losses: Float[Array | np.ndarray, "iteration start"],
    values: Float[Array | np.ndarray, "iteration start dim"],
    ranges: tuple[Range, ...],
    truth: Float[Array | np.ndarray, " dim"] | None = None,
    title: str = "",
) -> Path:
    """How the loss and the parameters of each start went, over the iterations.

    `losses` [m^2]: half of a mean square, shown as the rms distance; `values`, `truth`: one per
    range, else ValueError, in its unit; its bounds are the limits of a panel. The start that
    reached the lowest loss is emphasised; losses that are not finite leave gaps.
    """
    distances = _millimetres(losses)
    best = int(np.where(np.isfinite(distances), distances, np.inf).min(axis=0).argmin())
    figure, panels = _grid(1 + len(ranges), title)
    _trace(panels[0], distances, best)
    _log_distance(panels[0])
    panels[0].set_ylabel("rms distance [mm]")
    for axes, bound, lines in zip(panels[1:], ranges, np.asarray(values).T, strict=True):
        _trace(axes, lines.T, best)
        _bounds(axes, bound, "y")
    if truth is not None:
        for axes, value in zip(panels[1:], np.asarray(truth), strict=True):
            axes.axhline(value, color=VERMILION, linestyle="--", label="truth")
    for axes in panels:
        axes.set_xlabel("iteration")
        axes.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    _legend(figure, panels)
    return save(figure, path)


def loss_lines(
    path: Path | str,
    lines: Sequence[tuple[Range, Any, Any]],
    at: Float[Array | np.ndarray, " dim"],
    truth: Float[Array | np.ndarray, " dim"] | None = None,
    title: str = "",
) -> Path:
    """The loss along each parameter through the estimate.

    Each line: the range, values (n,) in its unit, and losses (n,) [m^2], half of a mean square,
    shown as the rms distance on an axis that all panels share: a parameter that the recording does
    not determine is flat. Losses that are not finite are crosses at the top, "diverged". `at`, the
    estimate, and `truth`: a value per line, else ValueError.
    """
    figure, panels = _grid(len(lines), title, sharey=True)
    every = np.concatenate([_millimetres(losses) for _, _, losses in lines])
    every = every[np.isfinite(every) & (every > 0)]
    for axes, (bound, values, losses), found in zip(panels, lines, np.asarray(at), strict=True):
        distances, values = _millimetres(losses), np.asarray(values)
        lost = values[~np.isfinite(distances)]
        axes.plot(values, distances, "o-", color=BLUE, markersize=3, label="loss")
        if len(lost):
            top: dict[str, Any] = {"transform": axes.get_xaxis_transform(), "clip_on": False}
            axes.plot(lost, np.full(len(lost), 0.96), "x", color=GREY, label="diverged", **top)
        axes.axvline(found, color="black", linewidth=1.2, label="estimate")
        _bounds(axes, bound, "x")
        axes.margins(y=0.12)  # room for the crosses
        if len(every) and every.max() > 10 * every.min():
            _log_distance(axes)
    if truth is not None:
        for axes, value in zip(panels, np.asarray(truth), strict=True):
            axes.axvline(value, color=VERMILION, linestyle="--", label="truth")
    figure.supylabel("rms distance [mm]", fontsize=10)
    _legend(figure, panels)
    return save(figure, path)


def bars(
    path: Path | str, names: Sequence[str], groups: Mapping[str, Any], ylabel: str, title: str
) -> Path:
    """Grouped bars, a group per recording.

    `names`: of the recordings; `groups`: the label of each bar in a group, such as "estimate", and
    its values (recording,) in the unit that `ylabel` names, else ValueError. A value that is not
    finite has no bar but a "-".
    """
    size = (max(6.0, 2.0 + 0.36 * len(names) * len(groups)), 4.6)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.add_subplot()
    width = 0.84 / max(1, len(groups))
    for i, (label, values) in enumerate(groups.items()):
        values = np.asarray(values, float)
        if values.shape != (len(names),):
            raise ValueError(f"{label}: expected {len(names)} values, found {values.shape}")
        places = np.arange(len(names)) + (i - (len(groups) - 1) / 2) * width
        heights = np.where(np.isfinite(values), values, 0.0)
        colour = BAR_COLOURS[i % len(BAR_COLOURS)]
        drawn = axes.bar(places, heights, 0.92 * width, label=label, color=colour)
        shown = [f"{value:.1f}" if np.isfinite(value) else "-" for value in values]
        axes.bar_label(drawn, shown, fontsize=7.5, padding=2)
    slant = {"rotation": 25, "ha": "right"} if max(map(len, names), default=0) > 12 else {}
    axes.set_xticks(range(len(names)), list(names), **slant)
    axes.set(ylabel=ylabel, title=title, axisbelow=True)
    axes.grid(axis="y", alpha=0.3)
    _legend(figure, [axes])
    return save(figure, path)


def save(figure: Figure, path: Path | str) -> Path:
    """Write a figure as PNG, whole or not at all."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    write_bytes(path, buffer.getvalue())
    return Path(path)


def thin(cloud: np.ndarray) -> np.ndarray:
    """At most MOST_DOTS finite points of a cloud, chosen at random, always the same."""
    return np.random.default_rng(0).permutation(cloud[np.isfinite(cloud).all(axis=1)])[:MOST_DOTS]


def inside(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> Any:
    """Which points lie in a box; not those that are not finite."""
    return ((points >= low) & (points <= high)).all(axis=1)


def limits(dots: np.ndarray, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The corners [m] of the box around the cloths and most of the dots."""
    low, high = np.percentile(dots, [1, 99], axis=0)
    # A cloth may be out of the cloud by half of its width; what is beyond flew off.
    reach = max(0.5 * float((high - low).max()), 0.05)
    near = vertices[inside(vertices, low - reach, high + reach)]
    low, high = np.min([low, *near], axis=0), np.max([high, *near], axis=0)
    return low - 0.04 * reach - 1e-3, high + 0.04 * reach + 1e-3


def _draw(axes: Any, dots: Any, cloth: Any, faces: Any, low: Any, high: Any) -> None:
    # Three-dimensional axes do not clip: what lies outside would run over the other panels.
    dots, shown = dots[inside(dots, low, high)], faces[inside(cloth, low, high)[faces].all(1)]
    axes.computed_zorder = False  # the dots lie over the cloth, whatever their depth
    colours: dict[str, Any] = {"facecolor": to_rgba(BLUE, 0.2), "edgecolor": to_rgba(BLUE, 0.6)}
    axes.add_collection3d(Poly3DCollection(cloth[shown], linewidth=0.3, **colours))
    axes.scatter(*dots.T, s=1.6, color=VERMILION, linewidths=0, depthshade=False, zorder=9)
    if len(shown) < len(faces):
        axes.text2D(0.5, 0.86, "cloth left the picture", ha="center", transform=axes.transAxes)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.12)
    for axis, name, pad in ((axes.xaxis, "x", -4), (axes.yaxis, "y", -4), (axes.zaxis, "z", -7)):
        axis.set_major_locator(MaxNLocator(3))
        axis.set_label_text(f"{name} [m]", fontsize=8)
        axis.labelpad = pad
    axes.tick_params(labelsize=7, pad=-3)


def _grid(count: int, title: str, sharey: bool = False) -> tuple[Figure, list[Any]]:
    rows = 1 if count <= 4 else 2
    columns = -(-count // rows)
    figure = Figure(figsize=(max(6.0, 3.1 * columns), 2.7 * rows + 0.9), layout="constrained")
    figure.suptitle(title, fontsize=13)
    panels = figure.subplots(rows, columns, sharey=sharey, squeeze=False).ravel()
    for i, axes in enumerate(panels):
        axes.grid(alpha=0.3) if i < count else axes.remove()
    return figure, list(panels[:count])


def _trace(axes: Any, lines: np.ndarray, best: int) -> None:
    others: dict[str, Any] = {"color": GREY, "linewidth": 0.9, "markersize": 2, "alpha": 0.7}
    axes.plot(np.delete(lines, best, axis=1), ".-", **others, label="other starts")
    axes.plot(lines[:, best], ".-", color=BLUE, linewidth=2.2, markersize=4, label="best start")


def _bounds(axes: Any, bound: Range, which: str) -> None:
    label = bound.name if bound.unit in ("", "-") else f"{bound.name} [{bound.unit}]"
    axes.set(**{f"{which}scale": "log" if bound.log else "linear", f"{which}label": label})
    axes.set(**{f"{which}lim": (bound.low, bound.high)})


def _log_distance(axes: Any) -> None:
    axes.set_yscale("log")  # 1, 2, 5, 10 on it, not 10^0
    axes.yaxis.set(major_locator=LogLocator(subs=(1, 2, 5)), major_formatter="{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())


def _millimetres(losses: Any) -> np.ndarray:
    """The rms distance [mm] of losses [m^2]: NaN where one is not finite, or below zero."""
    known = np.isfinite(losses) & (np.asarray(losses) >= 0)
    return np.sqrt(2 * np.where(known, losses, np.nan)) * 1e3


def _legend(figure: Figure, panels: Sequence[Any]) -> None:
    pairs = [zip(*axes.get_legend_handles_labels(), strict=True) for axes in panels]
    named = {label: handle for pair in pairs for handle, label in pair}  # each label once
    options: dict[str, Any] = {"loc": "outside lower center", "ncols": max(1, len(named))}
    figure.legend(list(named.values()), list(named), frameon=False, **options)
