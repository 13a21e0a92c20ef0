"""From depth images to points."""

import numpy as np
from jaxtyping import Bool, Float

from r2s.recordings.cameras.calibration import DepthCamera, rays


def depth_jumps(
    depth: Float[np.ndarray, "down across"], limit: float
) -> Bool[np.ndarray, "down across"]:
    """Pixels at which the depth [m] jumps by more than `limit` [m] to a neighbour that has one.

    There a pixel sees two surfaces at once, and cameras report a depth in between.
    """
    jumps = np.zeros(depth.shape, bool)
    for lines, marked in ((depth, jumps), (depth.T, jumps.T)):  # of two rows, of two columns
        jump = (np.abs(np.diff(lines, axis=0)) > limit) & (lines[1:] > 0) & (lines[:-1] > 0)
        marked[1:] |= jump
        marked[:-1] |= jump
    return jumps


def back_project(
    camera: DepthCamera,
    depth: Float[np.ndarray, "down across"],
    where: Bool[np.ndarray, "down across"],
) -> Float[np.ndarray, "point 3"]:
    """What the pixels `where` see, in the camera's axes [m], row by row."""
    along = depth[where].astype(np.float64)
    return np.concatenate([rays(camera)[where] * along[:, None], along[:, None]], axis=1)


def moved(pose: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "*_ 3"]) -> np.ndarray:
    """Points [m] after a rotation and shift given as a 4 x 4 matrix."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def from_world(camera: DepthCamera, points: Float[np.ndarray, "*_ 3"]) -> np.ndarray:
    """World points [m] in the camera's axes."""
    pose = np.array(camera.to_world)
    return (points - pose[:3, 3]) @ pose[:3, :3]
