"""Simulated sheets beside the recording: a picture of all configurations, and a video.

Needs matplotlib: pip install 'r2s[study]'. Videos are MP4 where OpenCV is installed (extra
camera), else GIF.
"""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from r2s.study.configuration import MOTIONS
from r2s.study.report.figures import (
    Figure,
    MaxNLocator,
    Poly3DCollection,
    colour_of,
    inside,
    limits,
    save,
    thin,
    to_rgba,
)
from r2s.study.report.motions import MotionComparison
from r2s.viewer import video_writer

DOTS = "#404040"
VIEW = {"projection": "3d", "elev": 15, "azim": -60}
RECORDING = "recording [m]"
ACROSS = 5  # panels in a row of a video, at most


def overview(path: Path | str, comparisons: Sequence[MotionComparison]) -> Path:
    """Draw a row for each recording: the sheet of every configuration, and the points at the right.

    Recordings come in the order of `MOTIONS`, each at its `late_frame`. Panels of a row share their
    limits; what flew out of them is left out, and said. Raises ValueError without a recording.
    """
    if not comparisons:
        raise ValueError("no recording to show")
    rows = in_order(comparisons)
    labels = list(dict.fromkeys(label for each in rows for label in each.motions))
    size = (0.9 + 1.7 * (len(labels) + 1), 0.5 + 1.8 * len(rows))  # [inch]
    figure = Figure(figsize=size)
    figure.subplots_adjust(
        left=0.45 / size[0], right=1 - 0.45 / size[0], bottom=0.02, top=1 - 0.5 / size[1],
        wspace=0.02, hspace=0.06,
    )  # fmt: skip
    panels = figure.subplots(len(rows), len(labels) + 1, subplot_kw=VIEW, squeeze=False)
    for each, row in zip(rows, panels, strict=True):
        frame = late_frame(each)
        box = _box(each, frame)
        dots = thin(each.clouds[frame])
        for label, axes in zip(labels, row, strict=False):
            sheet = each.motions.get(label)
            _dress(axes, box, is_labelled=False)
            if sheet is None:
                axes.text2D(0.5, 0.5, "not run", ha="center", fontsize=9, transform=axes.transAxes)
                continue
            _draw(axes, dots[:400], sheet[frame], each.faces, box, colour_of(labels.index(label)))
        _dress(row[-1], box, is_labelled=True)
        _draw(row[-1], dots, None, each.faces, box, DOTS)
        middle = row[0].get_position()
        text = f"{each.evaluated_on}, {each.times[frame]:.2f} s\n{each.fabric.replace('_', ' ')}"
        figure.text(0.12 / size[0], (middle.y0 + middle.y1) / 2, text, rotation=90, va="center",
                    ha="left", fontsize=9)  # fmt: skip
    for label, axes in zip([*labels, RECORDING], panels[0], strict=True):
        middle = axes.get_position()
        words = label.rsplit(" ", 2) if label.count(" ") > 1 else [label]
        heading = words[0] + ("\n" + " ".join(words[1:]) if len(words) > 1 else "")
        figure.text((middle.x0 + middle.x1) / 2, 1 - 0.06 / size[1], heading, ha="center", va="top",
                    fontsize=9)  # fmt: skip
    return save(figure, path)


def in_order(comparisons: Iterable[MotionComparison]) -> list[MotionComparison]:
    """Recordings in the order of `MOTIONS`, others after them."""
    order = {motion: i for i, motion in enumerate(MOTIONS)}
    return sorted(comparisons, key=lambda each: order.get(each.evaluated_on, len(order)))


def late_frame(comparison: MotionComparison) -> int:
    """The frame of the later half whose points are, on average, farthest from the first cloud.

    Clouds with less than half of the points of the largest do not count: cameras saw little then.
    """
    counts = [len(cloud) for cloud in comparison.clouds]
    full = [i for i, count in enumerate(counts) if count and 2 * count >= max(counts)]
    later = [i for i in full if i >= len(counts) // 2] or full or [len(counts) - 1]
    tree = KDTree(comparison.clouds[full[0]]) if full else None
    away = [
        0.0 if tree is None else float(tree.query(comparison.clouds[i])[0].mean()) for i in later
    ]
    return later[int(np.argmax(away))]


def video(folder: Path, comparison: MotionComparison) -> Path:
    """Write a video of all configurations side by side, over the points, in real time; its path."""
    interval = float(np.median(np.diff(comparison.times))) if len(comparison.times) > 1 else 1.0
    stem = comparison.recording.replace("/", "_")
    return video_writer.write_video(folder, stem, pictures(comparison), interval)


def pictures(comparison: MotionComparison) -> Iterator[np.ndarray]:
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
        for i, (label, axes) in enumerate(zip(labels, panels, strict=False)):
            sheet = comparison.motions[label][frame] if label else None
            dots = thin(comparison.clouds[frame])[:600]
            drawn += _draw(axes, dots, sheet, comparison.faces, box, colour_of(i))
        caption.set_text(f"{comparison.recording}, {comparison.times[frame]:.2f} s")
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()
        for artist in drawn:
            artist.remove()


def _box(comparison: MotionComparison, frame: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Limits [m] that hold the recording and sheets that did not fly off; or those of a frame."""
    dots = [thin(cloud) for cloud in comparison.clouds]
    sheets = [x.reshape(-1, 3) for x in comparison.motions.values()]
    every = np.concatenate(dots) if any(map(len, dots)) else np.zeros((1, 3))
    low, high = limits(every, np.concatenate([np.zeros((0, 3)), *sheets]))
    if frame is None:
        return low, high
    here = np.concatenate([dots[frame], *(x[frame] for x in comparison.motions.values())])
    here = here[inside(here, low, high)]
    if not len(here):
        return low, high
    # Strays of the cloud do not widen the picture.
    ends = np.percentile(here, [0.2, 99.8], axis=0)
    margin = 0.03 * float((ends[1] - ends[0]).max()) + 1e-3
    return ends[0] - margin, ends[1] + margin


def _dress(axes: Any, box: tuple[np.ndarray, np.ndarray], is_labelled: bool) -> None:
    low, high = box
    axes.computed_zorder = False  # the dots lie over the cloth, whatever their depth
    axes.patch.set_alpha(0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.2)
    if not is_labelled:
        axes.set_axis_off()
        return
    for i, axis in enumerate((axes.xaxis, axes.yaxis, axes.zaxis)):
        is_short = 3 * (high - low)[i] < (high - low).max()
        axis.set_major_locator(MaxNLocator(1 if is_short else 2))
    axes.tick_params(labelsize=6, pad=-5)
    axes.tick_params("z", pad=-3)


def _draw(axes: Any, dots: Any, sheet: Any, faces: Any, box: Any, colour: str) -> list[Any]:
    drawn = []
    # Three-dimensional axes do not clip: what lies outside would run over the other panels.
    dots = dots[inside(dots, *box)]
    if sheet is not None:
        kept = faces[inside(sheet, *box)[faces].all(axis=1)]
        style: dict[str, Any] = {"facecolor": to_rgba(colour, 0.35), "edgecolor": colour}
        drawn.append(axes.add_collection3d(Poly3DCollection(sheet[kept], linewidth=0.3, **style)))
        if len(kept) < len(faces):
            text = "diverged" if not np.isfinite(sheet).all() else "part is out of the picture"
            where: dict[str, Any] = {"ha": "center", "transform": axes.transAxes}
            drawn.append(axes.text2D(0.5, 0.02, text, fontsize=8, **where))
    style = {"s": 1.2, "color": DOTS, "linewidths": 0, "depthshade": False, "zorder": 9}
    drawn.append(axes.scatter(*dots.T, **style))
    return drawn
