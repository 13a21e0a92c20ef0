"""Simulated sheets over the recorded points: a picture of a frame, and a video.

Needs matplotlib: pip install 'r2s[study]'. Videos are MP4 where OpenCV is installed (extra
camera), else GIF.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from r2s.study.configuration import MOTIONS
from r2s.study.report.figures import (
    Figure,
    Looks,
    MaxNLocator,
    NullLocator,
    Poly3DCollection,
    inside,
    limits,
    save,
    thin,
    to_rgba,
)
from r2s.study.report.motions import MotionComparison
from r2s.viewer import video_writer

DOTS = "#c4004f"  # unlike any sheet
VIEW = {"projection": "3d", "elev": 15, "azim": -50}
RECORDING = "recording [m]"
ACROSS = 6  # panels in a row, at most


def sheets(path: Path | str, comparison: MotionComparison, frame: int, looks: Looks) -> Path:
    """Draw the sheet of every configuration over the points of a frame, and the points alone last.

    Panels share their limits; what flew out of them is left out, and said.
    """
    labels = [*comparison.motions, ""]
    across = min(ACROSS, len(labels))
    down = -(-len(labels) // across)
    size = (2.0 * across, 0.35 + 2.3 * down)  # [inch]
    figure = Figure(figsize=size)
    figure.subplots_adjust(
        left=0.2 / size[0], right=1 - 0.4 / size[0], bottom=0.2 / size[1], top=1 - 0.7 / size[1],
        wspace=0.04, hspace=0.25,
    )  # fmt: skip
    panels = figure.subplots(down, across, subplot_kw=VIEW, squeeze=False).ravel()
    for axes in panels[len(labels) :]:
        axes.remove()
    box, dots = _box(comparison, frame), thin(comparison.clouds[frame])
    for label, axes in zip(labels, panels, strict=False):
        _dress(axes, box, is_labelled=not label)
        axes.set_title(_heading(comparison, label, frame), fontsize=9, y=1.0, va="bottom")
        sheet = comparison.motions[label][frame] if label else None
        seen = dots if sheet is None else dots[:400]
        _draw(axes, seen, sheet, comparison.faces.get(label), box, _colour(looks, label))
    title = f"{comparison.evaluated_on}, {comparison.fabric.replace('_', ' ')}"
    text = f"{title}: {comparison.times[frame]:.2f} s"
    figure.text(0.1 / size[0], 1 - 0.06 / size[1], text, ha="left", va="top", fontsize=11)
    return save(figure, path)


def _heading(comparison: MotionComparison, label: str, frame: int) -> str:
    """A label in two lines, and its error in the frame."""
    if not label:
        return RECORDING
    error = 1e3 * comparison.mean_errors[label][frame]
    told = f"{error:.1f} mm" if np.isfinite(error) else "diverged"
    first, *rest = label.rsplit(" ", 2)
    return f"{first}\n{' '.join(rest)}: {told}"


def _colour(looks: Looks, label: str) -> str:
    return looks[label].colour if label else DOTS


def in_order(comparisons: Iterable[MotionComparison]) -> list[MotionComparison]:
    """Recordings in the order of `MOTIONS`, others after them."""
    order = {motion: i for i, motion in enumerate(MOTIONS)}
    return sorted(comparisons, key=lambda each: order.get(each.evaluated_on, len(order)))


def video(folder: Path, comparison: MotionComparison, looks: Looks) -> Path:
    """Write a video of all configurations side by side, over the points, in real time; its path."""
    interval = float(np.median(np.diff(comparison.times))) if len(comparison.times) > 1 else 1.0
    stem = comparison.recording.replace("/", "_")
    return video_writer.write_video(folder, stem, pictures(comparison, looks), interval)


def pictures(comparison: MotionComparison, looks: Looks) -> Iterator[np.ndarray]:
    """Each frame as a picture, (height, width, 3) in 0..255, of even sides."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    labels, box = [*comparison.motions, ""], _box(comparison)
    across = min(ACROSS, len(labels))
    down = -(-len(labels) // across)
    figure = Figure(figsize=(2.4 * across, 2.5 * down + 0.3), dpi=100)
    canvas = FigureCanvasAgg(figure)
    figure.subplots_adjust(0.01, 0.01, 0.99, 1 - 0.3 / (2.5 * down + 0.3), wspace=0.02, hspace=0.12)
    panels = figure.subplots(down, across, subplot_kw=VIEW, squeeze=False).ravel()
    for axes in panels[len(labels) :]:
        axes.remove()
    for label, axes in zip(labels, panels, strict=False):
        _dress(axes, box, is_labelled=not label)
        axes.set_title(label or RECORDING, fontsize=9, y=0.97)
    caption = figure.text(0.01, 0.995, "", va="top", fontsize=10)
    for frame in range(len(comparison.times)):
        drawn = []
        dots = thin(comparison.clouds[frame])[:600]
        for label, axes in zip(labels, panels, strict=False):
            sheet = comparison.motions[label][frame] if label else None
            faces = comparison.faces.get(label)
            drawn += _draw(axes, dots, sheet, faces, box, _colour(looks, label))
        caption.set_text(f"{comparison.recording}, {comparison.times[frame]:.2f} s")
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()
        for artist in drawn:
            artist.remove()


def _box(comparison: MotionComparison, frame: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Limits [m] that hold the recording and sheets that did not fly off; or those of a frame."""
    dots = [thin(cloud) for cloud in comparison.clouds]
    motions = list(comparison.motions.values())
    sheets = [x.reshape(-1, 3) for x in motions]
    every = np.concatenate(dots) if any(map(len, dots)) else np.zeros((1, 3))
    low, high = limits(every, np.concatenate([np.zeros((0, 3)), *sheets]))
    if frame is None:
        return low, high
    seen, cloth = dots[frame], np.concatenate([np.zeros((0, 3)), *(x[frame] for x in motions)])
    seen, cloth = seen[inside(seen, low, high)], cloth[inside(cloth, low, high)]
    if not len(seen) + len(cloth):
        return low, high
    # Strays of the cloud do not widen the picture; a sheet that did not fly off is all in it.
    trimmed = [np.percentile(seen, end, axis=0) for end in (0.2, 99.8)] if len(seen) else []
    every = np.concatenate([cloth, *(end[None] for end in trimmed)])
    ends = every.min(axis=0), every.max(axis=0)
    margin = 0.03 * float((ends[1] - ends[0]).max()) + 1e-3
    return ends[0] - margin, ends[1] + margin


def _dress(axes: Any, box: tuple[np.ndarray, np.ndarray], is_labelled: bool) -> None:
    low, high = box
    axes.computed_zorder = False  # the dots lie over the cloth, whatever their depth
    axes.patch.set_alpha(0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.1)
    if not is_labelled:
        axes.set_axis_off()
        return
    for i, axis in enumerate((axes.xaxis, axes.yaxis, axes.zaxis)):
        is_short = 3 * (high - low)[i] < (high - low).max()
        axis.set_major_locator(NullLocator() if is_short else MaxNLocator(2))
    axes.tick_params(labelsize=6, pad=-5)
    axes.tick_params("z", pad=-3)


def _draw(axes: Any, dots: Any, sheet: Any, faces: Any, box: Any, colour: str) -> list[Any]:
    drawn = []
    # Three-dimensional axes do not clip: what lies outside would run over the other panels.
    dots = dots[inside(dots, *box)]
    if sheet is not None:
        kept = faces[inside(sheet, *box)[faces].all(axis=1)]
        style: dict[str, Any] = {
            "facecolor": to_rgba(colour, 0.2),
            "edgecolor": to_rgba(colour, 0.6),
        }
        drawn.append(axes.add_collection3d(Poly3DCollection(sheet[kept], linewidth=0.3, **style)))
        if len(kept) < len(faces):
            text = "diverged" if not np.isfinite(sheet).all() else "part is out of the picture"
            where: dict[str, Any] = {"ha": "center", "transform": axes.transAxes}
            drawn.append(axes.text2D(0.5, 0.02, text, fontsize=8, **where))
    style = {"s": 2.2, "color": DOTS, "linewidths": 0, "depthshade": False, "zorder": 9}
    drawn.append(axes.scatter(*dots.T, **style))
    return drawn
