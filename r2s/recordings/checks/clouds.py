"""Are there enough points, on the sheet alone, and was none of it cut off?"""

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from r2s.recordings.cameras.cleaning import outliers
from r2s.recordings.checks.finding import Finding
from r2s.recordings.checks.seen import VOXEL, Seen
from r2s.recordings.checks.sheet import reach
from r2s.recordings.recording import Recording, clouds_are_markers

NEIGHBOURS, DEVIATIONS = 8, 6.0  # beyond which a point is alone
BEYOND = 1.15  # of how far the sheet reaches: no point of it is there
FACE = 0.003  # [m], as thick as the layer along a face of a box that cut the cloud
CROWDED = 30  # points in that layer, so that a face is one
SAME = 0.0015  # [m], within which the ends of clouds agree where a box cut them
ABOVE = 0.025  # [m] above the table, below which clouds are often cut on purpose


def check_clouds(seen: Seen) -> list[Finding]:
    """Number of points, outliers, faces of a box that cut the clouds, distance of the grippers."""
    recording = seen.recording
    if clouds_are_markers(recording):
        return []
    first, last = recording.info.frames_used
    clouds, held = seen.thinned[first : last + 1], seen.grippers[first : last + 1]
    pairs = list(zip(clouds, held, strict=True))
    near = [np.max(KDTree(points).query(at)[0]) for points, at in pairs]
    return [
        Finding.make("points", float(np.median([len(points) for points in clouds]))),
        Finding.make("outliers", float(np.median([_stray(recording, *pair) for pair in pairs]))),
        Finding.make("grip", float(np.median(near))),
        *_faces(recording, clouds),
    ]


def _stray(
    recording: Recording,
    points: Float[np.ndarray, "point 3"],
    held: Float[np.ndarray, "gripper 3"],
) -> float:
    """Share of points that are alone, or farther from a gripper than the sheet reaches."""
    sheet = recording.info.sheet
    far = np.zeros(len(points), bool)
    for name, at in zip(sheet.held, held, strict=True):
        far |= np.linalg.norm(points - at, axis=1) > BEYOND * reach(sheet, name)
    return float(np.mean(far | outliers(points, NEIGHBOURS, DEVIATIONS)))


def _faces(recording: Recording, clouds: list[np.ndarray]) -> list[Finding]:
    """Whether clouds end at one face of a box in many frames, where points crowd."""
    found = []
    for axis, letter in enumerate("xyz"):
        for side, name in ((-1, "below"), (1, "above")):
            share, place = _cut(clouds, axis, side)
            if axis == 2 and side < 0 and place < recording.info.table_height + ABOVE:
                continue  # the table, or a cut just above it
            words = f"share of frames whose clouds are cut {name} {letter} = {place:.3f} m"
            found.append(Finding.make("crop", share, words, f"crop {letter}"))
    return found


def _cut(clouds: list[np.ndarray], axis: int, side: int) -> tuple[float, float]:
    """In which share of the frames clouds end, crowded, at their farthest end, and where [m]."""
    ends = np.array([side * np.max(side * points[:, axis]) for points in clouds])
    place = side * np.max(side * ends)
    crowd = np.array([np.sum(side * (place - points[:, axis]) < FACE + VOXEL) for points in clouds])
    there = (np.abs(ends - place) < SAME + VOXEL / 2) & (crowd >= CROWDED)
    return float(np.mean(there)), float(place)
