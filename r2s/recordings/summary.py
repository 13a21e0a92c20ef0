"""What is in recordings: counts, extents and gaps, for a first look at data.

python -m r2s.recordings.summary FOLDER    a table of all recordings in a folder
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from r2s.recordings.readers.clouds import voxel_means
from r2s.recordings.recording import Recording, cloud

VOXEL, REACH = 0.01, 0.02  # [m]: thinned to the first, points closer than the second are connected
FEW = 0.25  # of the median number of points: frames with fewer are thin


@dataclass(frozen=True)
class Summary:
    """Points and gaps of one recording.

    - `points`: least, median and greatest number in a frame.
    - `low`, `high`: corners of the box that holds 99.8 % of all points along each axis, [m].
    - `thin`: frames with less than a quarter of the median number of points.
    - `longest`: the longest time between two frames, and the median, [s].
    - `parts`: median over the frames of the number of parts that are more than 20 mm apart.
    - `apart`: median over the frames of the share of the sheet that is not in the largest part.
    - `spacing`: median distance of a point to the next, [m].
    """

    name: str
    frames: int
    points: tuple[int, int, int]
    low: tuple[float, ...]
    high: tuple[float, ...]
    thin: tuple[int, ...]
    longest: tuple[float, float]
    parts: float
    apart: float
    spacing: float


def summarise(recording: Recording) -> Summary:
    """Counts, extents and gaps of a recording."""
    from scipy.spatial import KDTree

    clouds = [cloud(recording, frame) for frame in range(len(recording.times))]
    counts = np.array([len(points) for points in clouds])
    everything = np.concatenate(clouds)
    low, high = np.quantile(everything, [0.001, 0.999], axis=0)
    intervals = np.diff(np.asarray(recording.times, np.float64)) if len(clouds) > 1 else np.zeros(1)
    connected = np.array([_parts(points) for points in clouds])
    next_to = [KDTree(points).query(points, 2)[0][:, 1] for points in clouds if len(points) > 1]
    return Summary(
        name=recording.info.name,
        frames=len(clouds),
        points=(int(counts.min()), int(np.median(counts)), int(counts.max())),
        low=tuple(low.tolist()),
        high=tuple(high.tolist()),
        thin=tuple(np.flatnonzero(counts < FEW * np.median(counts)).tolist()),
        longest=(float(intervals.max()), float(np.median(intervals))),
        parts=float(np.median(connected[:, 0])),
        apart=float(np.median(connected[:, 1])),
        spacing=float(np.median(np.concatenate(next_to))) if next_to else 0.0,
    )


def table(recordings: Sequence[Recording]) -> str:
    """A Markdown table, one recording a line."""
    titles = (
        "recording | frames | points least, median, most | x [m] | y [m] | z [m] | "
        "longest interval [s] | thin frames | parts | outside of the largest | spacing [mm]"
    )
    rule = "|".join(["---"] * (titles.count("|") + 1))
    return "\n".join([f"| {titles} |", f"|{rule}|", *(_row(summarise(r)) for r in recordings)])


def _row(found: Summary) -> str:
    extents = [f"{a:.2f} to {b:.2f}" for a, b in zip(found.low, found.high, strict=True)]
    cells = [
        found.name,
        str(found.frames),
        ", ".join(map(str, found.points)),
        *extents,
        f"{found.longest[0]:.3g} (median {found.longest[1]:.3g})",
        ", ".join(map(str, found.thin)) or "none",
        f"{found.parts:g}",
        f"{found.apart:.0%}",
        f"{1e3 * found.spacing:.1f}",
    ]
    return f"| {' | '.join(cells)} |"


def _parts(points: np.ndarray) -> tuple[int, float]:
    """How many parts a cloud has, and which share of it is outside of the largest."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    cells = voxel_means(points, VOXEL)
    pairs = KDTree(cells).query_pairs(REACH, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(cells), len(cells)))
    count, label = connected_components(links, directed=False)
    return count, 1 - np.bincount(label).max() / len(cells)


def main(folder: str) -> None:
    from r2s.recordings.manifest import manifest_for, read_recording, read_recordings

    manifest = manifest_for(folder)
    names = read_recordings(folder, manifest)
    if not names:
        raise FileNotFoundError(f"{folder}: no recordings that fit {Path(folder)}/manifest.json")
    print(table([read_recording(folder, manifest, name) for name in names]))


if __name__ == "__main__":
    main(*sys.argv[1:])
