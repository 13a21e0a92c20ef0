"""Pictures of an estimate and of a prediction: simulated sheets in the recorded cloud, and the
prior and posterior of each parameter.

Needs matplotlib: pip install 'r2s[study]'.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from r2s.estimation.estimate import Estimate
from r2s.materials.parameters import InformedSpace, ParameterSpace, Range
from r2s.metrics.losses import to_surface
from r2s.recordings.open import SimulatedCloth
from r2s.recordings.recording import Recording, cloud
from r2s.viewer.cuts import write_figure
from r2s.viewer.pictures import (
    CLOTH,
    GREY,
    Content,
    Figure,
    draw_frame,
    draw_surroundings,
    draw_title_and_legend,
)

FRAMES = 3  # of the motion, evenly spaced, the last one included
PANEL = 3.4  # [inch], side of a frame's panel
STRIP = 1.9  # [inch], height of a row of densities
COLUMNS = 4  # of these rows
PRIOR, POSTERIOR = "prior", "posterior"


def draw_prediction(path: Path, recording: Recording, sheets: Mapping[str, SimulatedCloth]) -> Path:
    """Write a PNG with a row for each simulated sheet: three frames, with the recorded cloud.

    - `sheets`: by name, simulated at the recording's times.

    Under each frame stands the mean distance of all its points from the sheet. Returns `path`.
    """
    height = PANEL * len(sheets) + 1.0
    figure = Figure(figsize=(PANEL * FRAMES, height))
    _rows_of_frames(figure, recording, sheets, top=1 - 0.5 / height, bottom=0.7 / height)
    return write_figure(path, figure)


def draw_estimate(
    path: Path,
    estimate: Estimate,
    space: ParameterSpace,
    recording: Recording | None = None,
    sheet: SimulatedCloth | None = None,
) -> Path:
    """Write a PNG of an estimate: prior and posterior of each parameter of its `space`, and, of a
    `recording`, the estimated `sheet` in three frames. Returns `path`."""
    rows = -(-len(estimate.ranges) // COLUMNS)
    frames = 0.0 if recording is None else PANEL + 0.9
    height = frames + STRIP * rows + 0.3
    figure = Figure(figsize=(PANEL * FRAMES, height))
    if recording is not None and sheet is not None:
        bottom = 1 - (frames - 0.5) / height
        sheets = {"estimate": sheet}
        _rows_of_frames(figure, recording, sheets, top=1 - 0.5 / height, bottom=bottom)
    top = 1 - (frames + 0.3) / height
    grid: Any = figure.add_gridspec(
        rows, COLUMNS, left=0.05, right=0.97, top=top, bottom=0.5 / height, hspace=0.6, wspace=0.2
    )
    mean, precision = space.prior()
    prior_deviation = np.sqrt(np.diag(np.linalg.inv(np.asarray(precision))))
    informed = isinstance(space, InformedSpace)
    for i, bound in enumerate(estimate.ranges):
        axes = figure.add_subplot(grid[i // COLUMNS, i % COLUMNS])
        prior = (float(mean[i]), float(prior_deviation[i])) if informed else None
        _draw_densities(axes, bound, estimate, i, prior)
    return write_figure(path, figure)


def _rows_of_frames(
    figure: Any,
    recording: Recording,
    sheets: Mapping[str, SimulatedCloth],
    top: float,
    bottom: float,
) -> None:
    first, last = recording.info.frames_used
    frames = np.linspace(first, last, FRAMES + 1).round().astype(int)[1:]
    grid: Any = figure.add_gridspec(
        len(sheets), FRAMES, left=0.0, right=0.96, top=top, bottom=bottom, hspace=0.22, wspace=0.06
    )
    content = Content.make(recording, next(iter(sheets.values())))
    for row, (name, sheet) in enumerate(sheets.items()):
        clouds = [cloud(recording, int(frame)) for frame in frames]
        distances = to_surface(clouds, sheet.x[frames], jnp.asarray(sheet.faces))
        shown = content._replace(cloth=sheet)
        for column, (frame, away) in enumerate(zip(frames, distances, strict=True)):
            axes: Any = figure.add_subplot(grid[row, column], projection="3d")
            draw_surroundings(axes, shown)
            draw_frame(axes, shown, int(frame))
            axes.set_title(f"{name}, {float(recording.times[frame]):.2f} s", fontsize=10, y=0.98)
            distance = f"all points: mean {1e3 * away:.1f} mm" if np.isfinite(away) else "diverged"
            axes.text2D(0.5, -0.06, distance, ha="center", fontsize=10, transform=axes.transAxes)
    draw_title_and_legend(figure, shown)


def _draw_densities(
    axes: Any,
    bound: Range,
    estimate: Estimate,
    index: int,
    prior: tuple[float, float] | None,
) -> None:
    """Densities over the range of a parameter; a prior of None is uniform. The 90 % interval of the
    posterior is shaded."""
    place = np.linspace(0, 1, 401)
    values = np.asarray(bound.from_unit(jnp.asarray(place)))
    before = np.ones_like(place) if prior is None else np.asarray(_normal(place, *prior))
    axes.plot(values, before, color=GREY, linestyle="--", linewidth=1.2, label=PRIOR)
    error = float(estimate.standard_errors[index]) / bound.width
    if np.isfinite(error):
        mean = float(bound.to_unit(jnp.asarray(estimate.values[index], float)))
        after = np.asarray(_normal(place, mean, max(error, 1e-3)))
        axes.plot(values, after, color=CLOTH, linewidth=1.4, label=POSTERIOR)
        low, high = estimate.intervals[index]
        inside = (values >= low) & (values <= high)
        axes.fill_between(values, after, where=inside, color=CLOTH, alpha=0.25)
    axes.axvline(estimate.values[index], color=CLOTH, linewidth=0.8)
    axes.set_xscale("log" if bound.log else "linear")
    axes.set_xlim(bound.low, bound.high)
    axes.set_ylim(0, None)
    axes.set_yticks([])
    axes.minorticks_off()
    axes.tick_params(labelsize=7)
    unit = "" if bound.unit == "-" else f" [{bound.unit}]"
    axes.set_title(bound.name + unit, fontsize=9)
    if index == 0:
        axes.legend(fontsize=7, frameon=False)


def _normal(place: np.ndarray, mean: float, deviation: float) -> np.ndarray:
    """A normal density, scaled to an area of one over the unit interval."""
    density = np.exp(-0.5 * ((place - mean) / deviation) ** 2)
    return density / max(float(np.trapezoid(density, place)), 1e-12)
