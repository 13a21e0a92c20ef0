"""What checks look at: the frames' clouds, thinned and freed of stray points, and the grippers."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from r2s.recordings.readers.clouds import voxel_means
from r2s.recordings.recording import Recording, cloud, clouds_are_markers, gripper_positions

Points = Float[np.ndarray, "point 3"]

VOXEL = 0.005  # [m], to which clouds are thinned
AROUND, FEW = 0.02, 4  # [m], in which a point of a sheet has more others than that
APART, SCRAP = 0.03, 0.05  # [m] between pieces of a cloud; share of it below which one is no sheet
FEWEST = 50  # points, of a frame that shows something
STILL = 0.002  # [m], within which grippers are at rest


class Seen(NamedTuple):
    """- `recording`: all of it.
    - `thinned`: points of each frame, [m]. `clouds`: those that have others around, and are in a
      piece that is large enough to be a part of the sheet.
    - `grippers`: where they are in each frame, [m].
    - `still`: frames before the grippers move; the first one at least.
    """

    recording: Recording
    thinned: list[Points]
    clouds: list[Points]
    grippers: Float[np.ndarray, "frame gripper 3"]
    still: list[int]


def seen_in(recording: Recording) -> Seen:
    """What a recording shows, in metres."""
    thinned = [voxel_means(cloud(recording, f), VOXEL) for f in range(len(recording.times))]
    alone = clouds_are_markers(recording)  # far from each other
    clouds = thinned if alone else [_with_others(points) for points in thinned]
    return Seen(recording, thinned, clouds, gripper_positions(recording), _still(recording))


def lies(recording: Recording) -> bool:
    """Whether the sheet lies at rest, rather than hangs."""
    sheet = recording.info.sheet
    return bool(abs(np.cross(sheet.warp, sheet.weft)[2]) > 0.9)


def _with_others(points: Points) -> Float[np.ndarray, "kept 3"]:
    if len(points) <= FEW:
        return points
    around = KDTree(points).query_ball_point(points, AROUND, return_length=True)
    return _without_scraps(points[np.asarray(around) > FEW])


def _without_scraps(points: Points) -> Float[np.ndarray, "kept 3"]:
    if not len(points):
        return points
    pairs = KDTree(points).query_pairs(APART, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(points),) * 2)
    piece = connected_components(links, directed=False)[1]
    return points[(np.bincount(piece) >= SCRAP * len(points))[piece]]


def _still(recording: Recording) -> list[int]:
    path, knots = np.asarray(recording.handle_path), np.asarray(recording.handle_times)
    moved = np.linalg.norm(path - path[:1], axis=-1).max(axis=1) > STILL
    begins = float(knots[np.argmax(moved)]) if moved.any() else np.inf
    return np.flatnonzero(np.asarray(recording.times) <= begins).tolist() or [0]
