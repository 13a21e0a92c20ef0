"""A picture of what a segmentation cut off a recording, and of what it left."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from r2s._util.extras import require
from r2s._util.files import write_bytes
from r2s.recordings.segmentation import FATES, FrameCuts

# of `FATES`: Okabe and Ito's, which the colour-blind can tell apart; the cloth as in `show`
COLOURS = ("#cccccc", "#8c8c8c", "#F0E442", "#000000", "#56B4E9", "#CC79A7", "#D55E00")


def draw_cuts(path: Path, title: str, frames: Sequence[FrameCuts]) -> None:
    """Write a PNG of the first, middle and last frame: points in the colour of what became of them,
    but for those outside of the workspace, and the shares in all frames. OSError names the file."""
    figure = require("matplotlib.figure", "study", "--plot").Figure((12.6, 4.6))
    figure.subplots_adjust(0.0, 0.12, 0.96, 0.9, 0.1)
    total = np.sum([frame.counts for frame in frames], axis=0)
    for panel, number in enumerate((0, (len(frames) - 1) // 2, len(frames) - 1)):
        frame, dots = frames[number], {"linewidths": 0, "depthshade": False}
        axes: Any = figure.add_subplot(1, 3, panel + 1, projection="3d")
        for fate in np.flatnonzero(total):
            points = frame.points[(frame.fates == fate) & (fate > 0)]
            label = f"{FATES[fate]} {total[fate] / total.sum():.1%}"
            axes.scatter(*points.T, s=1.5, color=COLOURS[fate], label=label, **dots)
        axes.scatter(*frame.grippers.T, s=20, color="#000000", marker="x", label="place of gripper")
        axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
        axes.locator_params(nbins=5)
        axes.patch.set_visible(False)  # it would cover the labels of the panel to the left
        axes.set_title(f"frame {number}, {frame.time:.2f} s", fontsize=9)
    entries = figure.axes[0].get_legend_handles_labels()
    figure.legend(*entries, loc="lower center", ncols=8, fontsize=8, markerscale=2)
    figure.suptitle(title, fontsize=11)
    write_figure(path, figure)


def write_figure(path: Path, figure: Any) -> Path:
    """Write a figure of Matplotlib as PNG, whole or not at all; its path. OSError names it."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    write_bytes(path, buffer.getvalue())
    return path
