"""Pictures of the physics similarity map and of the curves of a training."""

import io
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from r2s.estimation.physnet.training import Row
from r2s.fabrics.parameters import Range
from r2s.files import write_bytes

COLUMNS = 4
MAP = "viridis"


def draw_map(
    path: Path | str,
    points: Float[np.ndarray, "image axis"],
    places: Float[np.ndarray, "image dim"],
    ranges: tuple[Range, ...],
    title: str = "",
) -> None:
    """Draw images on the map as PNG, for each parameter coloured by its place in its range.

    Of a map of more than two dimensions the plane in which it is widest is drawn.
    """
    points = _widest(points)
    figure, axes = _axes(len(ranges), 3.2)
    for axis, bound, column in zip(axes, ranges, places.T, strict=True):
        shown = axis.scatter(*points.T, c=column, s=5, cmap=MAP, vmin=0, vmax=1, linewidths=0)
        axis.set_title(f"{bound.name}: {bound.low:g} to {bound.high:g} {bound.unit}", fontsize=9)
        axis.set_aspect("equal", "datalim")
        figure.colorbar(shown, ax=axis)
    figure.suptitle(title, fontsize=10)
    _write(path, figure)


def _widest(points: Float[np.ndarray, "image axis"]) -> Float[np.ndarray, "image 2"]:
    """The points in the plane of their two greatest principal components."""
    if points.shape[1] == 2:
        return points
    centred = points - points.mean(axis=0)
    return centred @ np.linalg.svd(centred, full_matrices=False)[2][:2].T


def draw_curves(path: Path | str, curve: tuple[Row, ...], untrained: float | None = None) -> None:
    """Draw loss and triplet accuracy of every epoch as PNG, with chance and no training."""
    figure, (left, right) = _axes(2, 3.2)
    epochs = np.arange(1, len(curve) + 1)
    left.plot(epochs, [row.loss for row in curve], label="training")
    left.plot(epochs, [row.validation_loss for row in curve], label="fabrics held back")
    left.set(xlabel="epoch", ylabel="triplet loss", yscale="log")
    right.plot(epochs, [row.accuracy for row in curve], "C1", label="fabrics held back")
    right.axhline(0.5, color="0.6", linestyle=":", label="chance")
    if untrained is not None:
        right.axhline(untrained, color="0.6", linestyle="--", label="untrained")
    right.set(xlabel="epoch", ylabel="triplet accuracy", ylim=(0.45, 1))
    for axis in (left, right):
        axis.legend(fontsize=8)
    _write(path, figure)


def draw_images(path: Path | str, rows: dict[str, Float[np.ndarray, "frame down across"]]) -> None:
    """Draw sequences of grey images below each other as PNG."""
    count = max(len(images) for images in rows.values())
    figure, axes = _subplots(len(rows), count, 1.3)
    for line, (name, images) in zip(axes, rows.items(), strict=True):
        for axis, image in zip(line, images, strict=False):
            axis.imshow(image, cmap="gray", vmin=0, vmax=1)
        line[0].set_title(name, fontsize=8, loc="left")
        for axis in line:
            axis.axis("off")
    _write(path, figure)


def _axes(number: int, size: float) -> tuple[Any, list[Any]]:
    columns = min(number, COLUMNS)
    figure, axes = _subplots(-(-number // columns), columns, size)
    flat = list(axes.ravel())
    for axis in flat[number:]:
        axis.axis("off")
    return figure, flat[:number]


def _subplots(rows: int, columns: int, size: float) -> tuple[Any, Any]:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("pictures need matplotlib: pip install 'r2s[study]'") from error
    figure = Figure(figsize=(1.25 * size * columns, size * rows), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def _write(path: Path | str, figure: Any) -> None:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    write_bytes(path, buffer.getvalue())
