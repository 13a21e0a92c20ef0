"""The plane of the table: from places in an image to metres, by points or a checkerboard on it.

Places in an image are (x, y), x to the right and y down, [px]. Needs OpenCV: pip install
'r2s[camera]'.
"""

import numpy as np
from jaxtyping import Float

from r2s._util.extras import require


def plane_homography(
    pixels: Float[np.ndarray, "point 2"],
    metres: Float[np.ndarray, "point 2"],
    tolerance: float = 2e-3,
) -> Float[np.ndarray, "3 3"]:
    """The map from an image to the plane of the table, by least squares over known points.

    `pixels` [px] and `metres` [m] are the same points. Raises ValueError when there are fewer than
    four, when three of four lie on a line, or when it misses a point by more than `tolerance` [m]:
    then two are swapped, one is misread, or the lens bends (see `undistort`).
    """
    cv2 = require("cv2", "camera", "the plane of the table")
    if len(pixels) < 4 or len(pixels) != len(metres):
        found = f"found {len(pixels)} in the image and {len(metres)} on the table"
        raise ValueError(f"a plane needs at least four points, known in both: {found}")
    for name, points in (("image", pixels), ("table", metres)):
        if not np.isfinite(points).all():
            raise ValueError(f"the points in the {name} must be finite")
        extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if extent[1] < 1e-3 * extent[0]:
            raise ValueError(f"the points in the {name} lie on a line: spread them over the table")
    found, _ = cv2.findHomography(np.asarray(pixels, float), np.asarray(metres, float), 0)
    if found is None or not np.isfinite(found).all():
        raise ValueError("no plane fits the points: three of them lie on a line, or two coincide")
    misses = np.linalg.norm(to_metres(found, np.asarray(pixels, float)) - metres, axis=1)
    if misses.max() > tolerance:
        raise ValueError(
            f"the plane misses point {misses.argmax()} by {1e3 * misses.max():.1f} mm: two points "
            "are swapped, one is misread, or the lens distorts"
        )
    return np.asarray(found, float)


def checkerboard(
    image: np.ndarray, shape: tuple[int, int], square: float
) -> tuple[Float[np.ndarray, "point 2"], Float[np.ndarray, "point 2"]]:
    """The inner corners of a checkerboard on the table, [px] and [m], for `plane_homography`.

    `shape`: inner corners along the two sides, the first side being the x axis of the table;
    `square` [m]: side of a field. Raises ValueError when it is not seen.
    """
    cv2 = require("cv2", "camera", "the plane of the table")
    found, corners = cv2.findChessboardCornersSB(image, shape, None, cv2.CALIB_CB_ACCURACY)
    if not found:
        raise ValueError(
            f"no checkerboard with {shape[0]} x {shape[1]} inner corners: count the corners, not "
            "the fields, and show all of it with a white border"
        )
    x, y = np.meshgrid(np.arange(shape[0]), np.arange(shape[1]))
    return corners.reshape(-1, 2).astype(float), square * np.stack([x, y], -1).reshape(-1, 2)


def to_metres(
    homography: Float[np.ndarray, "3 3"], pixels: Float[np.ndarray, "*_ 2"]
) -> Float[np.ndarray, "*_ 2"]:
    """Places [px] in the image as places [m] on the plane; NaN stays NaN."""
    lifted = pixels @ homography[:, :2].T + homography[:, 2]
    return lifted[..., :2] / lifted[..., 2:]


def on_table(places: Float[np.ndarray, "*_ 2"], height: float) -> Float[np.ndarray, "*_ 3"]:
    """Places on the plane as points in the world, z up, at the table's height [m]."""
    return np.concatenate([places, np.full((*places.shape[:-1], 1), height)], axis=-1)


def undistort(
    pixels: Float[np.ndarray, "*_ 2"],
    matrix: Float[np.ndarray, "3 3"],
    distortion: Float[np.ndarray, " coefficient"],
) -> Float[np.ndarray, "*_ 2"]:
    """Places [px] as a lens without distortion would show them, by OpenCV's camera model."""
    cv2 = require("cv2", "camera", "the plane of the table")
    flat = np.ascontiguousarray(pixels.reshape(-1, 1, 2), float)
    return cv2.undistortPoints(flat, matrix, distortion, P=matrix).reshape(pixels.shape)
