"""A picture of what a segmentation cut off a recording, and what it left."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from r2s._util.extras import require
from r2s._util.files import write_bytes
from r2s.recordings.segmentation import FATES, FrameCuts

# Okabe and Ito's colours, which the colour-blind can tell apart; the cloth is orange as in `show`.
COLOURS = ("#cccccc", "#8c8c8c", "#F0E442", "#000000", "#56B4E9", "#CC79A7", "#D55E00")
PANELS = 3


def draw_cuts(path: Path, title: str, frames: Sequence[FrameCuts]) -> None:
    """Write a PNG of the first, the middle and the last frame: the points in the colour of what
    became of them, with the share of all points of the recording. OSError names the file."""
    figures = require("matplotlib.figure", "study", "--plot")
    chosen = np.unique(np.linspace(0, len(frames) - 1, PANELS).astype(int))
    figure = figures.Figure(figsize=(4.2 * len(chosen), 4.6), layout="constrained")
    total = np.sum([frame.counts for frame in frames], axis=0)
    for panel, number in enumerate(chosen):
        frame, dots = frames[number], {"s": 1.5, "linewidths": 0, "depthshade": False}
        axes: Any = figure.add_subplot(1, len(chosen), panel + 1, projection="3d")
        for fate, (name, colour) in enumerate(zip(FATES, COLOURS, strict=True)):
            points = frame.points[(frame.fates == fate) & (name != "outside")]
            label = f"{name} {total[fate] / total.sum():.1%}"
            axes.scatter(*points.T, color=colour, label=label, **dots)
        axes.scatter(*frame.grippers.T, s=25, color="#000000", marker="x", label="a gripper")
        axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
        axes.set_title(f"frame {number}, {frame.time:.2f} s", fontsize=9)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    legend = figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8)
    for handle in legend.legend_handles:
        handle.set_sizes([30])
    figure.suptitle(title, fontsize=11)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    write_bytes(path, buffer.getvalue())
