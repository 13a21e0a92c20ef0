"""Pictures of error over time: what each configuration leaves, beside floor and horizon.

Needs matplotlib: pip install 'r2s[study]'.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from r2s.study.configuration import is_reference
from r2s.study.report.figures import SAND, VERMILION, Figure, Look, Looks, save
from r2s.study.report.motions import MotionComparison

ABOVE = 1.1  # of the largest error that is shown, the upper end of the picture
RUNAWAY = 2.0  # times the largest default error: what is farther off is out of the picture


def error_picture(
    path: Path | str, comparison: MotionComparison, looks: Looks, frame: int | None = None
) -> Path:
    """Draw the mean error [mm] of each configuration's runs against time, and their range.

    The floor is shaded from zero, and what is beyond the horizon is pale. A line ends with a cross
    where one of its runs diverged, for from there on its mean is infinite. `frame`: is marked.
    Returns `path`; an OSError names it.
    """
    times, top = comparison.times, _top(comparison)
    figure = Figure(figsize=(7.2, 4.7), layout="constrained")
    axes = figure.add_subplot()
    if comparison.floor is not None:
        # An infinite floor fills the picture.
        floor = np.minimum(1e3 * comparison.floor, 2 * top)
        axes.fill_between(times, 0, floor, color=SAND, linewidth=0, label="floor")
    for label, mean in comparison.mean_errors.items():
        _draw(axes, times, comparison.errors[label], mean, label, looks[label], top)
    _draw_horizon(axes, times, comparison.horizon)
    if frame is not None:
        style: dict[str, Any] = {"color": "black", "clip_on": False, "zorder": 9}
        axes.plot(times[frame], 0, "^", label="frame of the sheets below", **style)
    axes.set(xlabel="time [s]", ylabel="distance to the simulated surface [mm]")
    axes.set(xlim=(times[0], max(times[-1], times[0] + 1e-3)), ylim=(0, top))
    axes.set_title(f"{comparison.evaluated_on}, {comparison.fabric.replace('_', ' ')}", fontsize=11)
    axes.grid(alpha=0.25)
    place: dict[str, Any] = {"loc": "outside lower center", "ncols": 2}
    figure.legend(frameon=False, fontsize=8, **place)
    return save(figure, path)


def _top(comparison: MotionComparison) -> float:
    """The upper end of the picture, [mm]: what runs away does not widen it."""

    def largest(labels: list[str]) -> float:
        runs = [comparison.errors[label].ravel() for label in labels]
        values = np.concatenate([np.zeros(0), *runs])
        return float(values[np.isfinite(values)].max(initial=0.0))

    references = largest([label for label in comparison.errors if is_reference(label)])
    every = largest(list(comparison.errors))
    return 1e3 * ABOVE * (min(every, RUNAWAY * references) if references else every) or 1.0


def _draw(
    axes: Any,
    times: Float[np.ndarray, " frame"],
    runs: Float[np.ndarray, "run frame"],
    mean: Float[np.ndarray, " frame"],
    label: str,
    look: Look,
    top: float,
) -> None:
    lost = int((~np.isfinite(runs).all(axis=1)).sum())
    words = f"{label} ({lost} of {len(runs)} diverged)" if lost else label
    if len(runs) > 1:
        kind = "draws" if label.startswith("default ") else "estimates"
        words += f", mean and range of {len(runs)} {kind}"
        ends = np.where(np.isfinite(runs), 1e3 * runs, np.inf)
        low, high = (np.minimum(end(ends, axis=0), 2 * top) for end in (np.min, np.max))
        axes.fill_between(times, low, high, color=look.colour, alpha=0.18, linewidth=0)
    known = np.isfinite(mean)
    style: dict[str, Any] = {"color": look.colour, "linestyle": look.line}
    axes.plot(times, np.where(known, 1e3 * mean, np.nan), linewidth=1.6, label=words, **style)
    if lost and known.any():
        last = np.flatnonzero(known)[-1]
        at = min(1e3 * mean[last], top)
        cross: dict[str, Any] = {"markersize": 10, "markeredgewidth": 2.5, "clip_on": False}
        axes.plot(times[last], at, "x", color=look.colour, zorder=8, **cross)


def _draw_horizon(axes: Any, times: Float[np.ndarray, " frame"], horizon: float | None) -> None:
    """A line at the horizon, with all beyond it pale; or the words that it is never reached."""
    if horizon is None:
        return
    style: dict[str, Any] = {"fontsize": 9, "color": VERMILION, "va": "top", "zorder": 9}
    if not np.isfinite(horizon):
        where = {"ha": "right", "transform": axes.transAxes}
        axes.text(0.99, 0.98, "the horizon is never reached", **where, **style)
        return
    axes.axvspan(horizon, max(times[-1], horizon), color="white", alpha=0.65, linewidth=0, zorder=5)
    axes.axvline(horizon, color=VERMILION, linewidth=1.5, zorder=6)
    is_late = horizon > times[0] + 0.7 * (times[-1] - times[0])
    text = f"horizon {horizon:.2f} s " if is_late else f" horizon {horizon:.2f} s"
    where = {"ha": "right" if is_late else "left", "transform": axes.get_xaxis_transform()}
    axes.text(horizon, 0.98, text, **where, **style)
