"""Printed dots on a sheet, followed through a video: from images to metres on the table.

    tracks = track(read_grey("stretch.mp4"), shape=(9, 9))
    homography = plane_homography(corners_in_pixels, corners_in_metres)  # plane
    markers = to_metres(homography, tracks.pixels)

OpenCV detects the dots and finds their grid in the first frame; it has no tracker for dots that are
covered for a while and come back. It also finds the corners of a checkerboard on the table
(`cv2.findChessboardCornersSB`), and removes the distortion of a lens (`cv2.undistortPoints`).

Images are grey, 8 bits, (height, width); places in them are (x, y), x to the right and y down,
[px], whole numbers at the centres of pixels. Needs OpenCV: pip install 'r2s[camera]'.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Integer
from scipy.spatial import KDTree

from r2s._util.extras import require

Places = Float[np.ndarray, "dot 2"]
Sizes = Float[np.ndarray, " dot"]

CONTRAST = 0.12  # a dot differs from the cloth by at least this part of its brightness
ROUND = 0.6  # least ratio of a dot's width to its length, in the image
CIRCULAR = 0.8  # least 4 pi area / perimeter^2 of a dot; of half a disc it is 0.75
SIZE_CHANGE = 1.14  # factor by which a dot may differ from the others in how its diameter changed
SMALLEST, LARGEST = 4.0, 6.0  # [px] a dot is across at least; at most this part of the image
STEP = 3  # grey levels from one threshold to the next
FIRST_BLUR = 1.6  # [px], before the size of the dots is known
GATE = 0.4  # of the spacing: farther from its prediction a dot is another one
CREDIBLE = 0.2  # of the spacing: farther from the smooth motion of all a dot is no marker


def plane_homography(
    pixels: Float[np.ndarray, "point 2"],
    metres: Float[np.ndarray, "point 2"],
    tolerance: float = 2e-3,
) -> Float[np.ndarray, "3 3"]:
    """The map from an image to the plane of the table, by least squares over known points.

    `pixels` [px] and `metres` [m] are the same points, four or more. Raises ValueError when they do
    not determine it, or when it misses one by more than `tolerance` [m].
    """
    cv2 = require("cv2", "camera", "the plane of the table")
    if len(pixels) < 4 or len(pixels) != len(metres):
        raise ValueError(
            "a plane needs at least four points, known in both: found "
            f"{len(pixels)} in the image and {len(metres)} on the table"
        )
    for name, points in (("image", pixels), ("table", metres)):
        if not np.isfinite(points).all():
            raise ValueError(f"the points in the {name} must be finite")
        extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if extent[1] < 1e-3 * extent[0]:
            raise ValueError(f"the points in the {name} lie on a line: spread them over the table")
    homography, _ = cv2.findHomography(np.asarray(pixels, float), np.asarray(metres, float), 0)
    if homography is None or not np.isfinite(homography).all():
        raise ValueError("no plane fits the points: three of them lie on a line, or two coincide")
    misses = np.linalg.norm(to_metres(homography, np.asarray(pixels, float)) - metres, axis=1)
    if misses.max() > tolerance:
        raise ValueError(
            f"the plane misses point {misses.argmax()} by {1e3 * misses.max():.1f} mm: two points "
            "are swapped, one is misread, or the lens distorts"
        )
    return homography


def to_metres(
    homography: Float[np.ndarray, "3 3"], pixels: Float[np.ndarray, "*_ 2"]
) -> Float[np.ndarray, "*_ 2"]:
    """Places [px] in the image as places [m] on the plane; NaN stays NaN."""
    lifted = pixels @ homography[:, :2].T + homography[:, 2]
    return lifted[..., :2] / lifted[..., 2:]


def on_table(places: Float[np.ndarray, "*_ 2"], height: float) -> Float[np.ndarray, "*_ 3"]:
    """Places on the plane as points in the world, z up, at the table's height [m]."""
    return np.concatenate([places, np.full((*places.shape[:-1], 1), height)], axis=-1)


class Tracks(NamedTuple):
    """Markers through a video, those of a grid row by row.

    - `pixels`: where they are, [px]; NaN where they are not seen.
    - `seen`: whether they are.
    - `shape`: rows and columns of the grid; marker (i, j) is number i * columns + j.
    """

    pixels: Float[np.ndarray, "frame marker 2"]
    seen: Bool[np.ndarray, "frame marker"]
    shape: tuple[int, int]


def track(
    frames: Iterable[np.ndarray],
    shape: tuple[int, int] = (9, 9),
    dark: bool = True,
    origin: tuple[float, float] | None = None,
) -> Tracks:
    """Follow the dots of a grid of `shape` (rows, columns) through the frames of a video.

    All must be seen in the first frame. From frame to frame a dot must be found within 0.4 of the
    grid's spacing of where its velocity takes it. A dot that is covered, even in part, is not seen;
    it is found again where a smooth motion of the others takes it.

    - `frames`: grey images, such as those of `r2s.recordings.images.read_grey`.
    - `dark`: whether the dots are darker than the cloth.
    - `origin`: place of the first marker in the first frame, [px]; see `find_grid`.

    Raises ValueError that names the frame, where the grid or half of its markers is not found.
    """
    pixels, seen = [], []
    state: _State | None = None
    for number, image in enumerate(frames):
        try:
            if state is None:
                centres, sizes = detect(image, dark)
                grid = find_grid(centres, shape, origin)
                places = centres[grid]
                visible = np.ones(len(grid), bool)
                state = _State(places, np.zeros_like(places), visible, sizes[grid], _smooth(shape))
            else:
                dots = detect(image, dark, float(np.median(state.sizes)))
                state = _follow(state, *dots)
        except ValueError as error:
            raise ValueError(f"frame {number}: {error}") from error
        pixels.append(np.where(state.seen[:, None], state.places, np.nan))
        seen.append(state.seen)
    if not pixels:
        raise ValueError("there are no frames to track markers in")
    return Tracks(np.stack(pixels), np.stack(seen), shape)


def detect(
    image: np.ndarray, dark: bool = True, diameter: float | None = None
) -> tuple[Places, Sizes]:
    """Centres and diameters [px] of the round dots, darker (or not) than what is around them.

    `diameter` [px] is about that of a dot; when None, that of most of the round dots in the image.
    OpenCV's blob detector looks at the image through many thresholds, so uneven light moves no
    centre. Raises ValueError when there is no dot.
    """
    if diameter is None:
        largest = min(image.shape) / LARGEST
        _, sizes = _blobs(image, dark, FIRST_BLUR, (SMALLEST, largest))
        if not len(sizes):
            raise ValueError(
                "no round dots in the image: are they darker than the cloth, and in focus"
            )
        similar = np.abs(np.log(sizes[:, None] / sizes)) < 0.25
        diameter = float(np.median(sizes[similar[similar.sum(axis=1).argmax()]]))
    limits = 0.6 * diameter, 1.6 * diameter
    centres, sizes = _blobs(image, dark, max(0.8, 0.1 * diameter), limits)
    if not len(centres):
        raise ValueError(f"no round dots of about {diameter:.0f} px across: is the light on?")
    return centres, sizes


def _blobs(
    image: np.ndarray, dark: bool, blur: float, diameters: tuple[float, float]
) -> tuple[Places, Sizes]:
    """Round blobs with diameters [px] between two limits, in an image smoothed by `blur` [px]."""
    cv2 = require("cv2", "camera", "markers")
    options = cv2.SimpleBlobDetector.Params()
    options.blobColor = 0 if dark else 255
    options.minThreshold, options.maxThreshold, options.thresholdStep = 5, 250, STEP
    options.minRepeatability = max(2, int(CONTRAST * np.median(image) / STEP))
    options.minArea, options.maxArea = (np.pi / 4 * size**2 for size in diameters)
    options.minDistBetweenBlobs = diameters[0]
    options.filterByConvexity = False
    options.filterByCircularity, options.minCircularity = True, CIRCULAR
    options.filterByInertia, options.minInertiaRatio = True, ROUND**2
    smooth = cv2.GaussianBlur(image, (0, 0), blur)
    blobs = cv2.SimpleBlobDetector.create(options).detect(smooth)
    centres = np.array([blob.pt for blob in blobs], float).reshape(-1, 2)
    return centres, np.array([blob.size for blob in blobs], float)


def find_grid(
    places: Places, shape: tuple[int, int], origin: tuple[float, float] | None = None
) -> Integer[np.ndarray, " marker"]:
    """The index of the dot of each marker of a grid of `shape` (rows, columns), by rows.

    The grid may be turned and seen at an angle, but not mirrored. Its first marker is the corner
    nearest to `origin` [px], or else the one from which columns run most to the right and rows most
    downward. Raises ValueError when the dots make no such grid, or a larger one.
    """
    grid = _circles_grid(places, shape)
    along, down = places[grid[0, -1]] - places[grid[0, 0]], places[grid[-1, 0]] - places[grid[0, 0]]
    if along[0] * down[1] <= along[1] * down[0]:  # mirrored
        grid = grid[:, ::-1]
    _check_whole(places, grid)
    turns = [turn for k in range(4) if (turn := np.rot90(grid, k)).shape == shape]
    if origin is None:
        return max(turns, key=lambda turn: _uprightness(places, turn)).reshape(-1)
    ends = grid[[0, 0, -1, -1], [0, -1, 0, -1]]
    nearest = ends[np.linalg.norm(places[ends] - np.array(origin), axis=1).argmin()]
    for turn in turns:
        if turn[0, 0] == nearest:
            return turn.reshape(-1)
    raise ValueError(
        f"from the corner at {tuple(np.round(places[nearest]).tolist())} px the grid has not "
        f"{shape[0]} rows and {shape[1]} columns, seen unmirrored: swap them, or name another"
    )


def _circles_grid(places: Places, shape: tuple[int, int]) -> Integer[np.ndarray, "row column"]:
    """The dots of a grid as OpenCV finds it, from any of its corners, mirrored or not."""
    cv2 = require("cv2", "camera", "markers")
    if min(shape) < 2:
        raise ValueError(f"a grid has two rows and columns or more, found the shape {shape}")
    dots, has_grid, corners = np.asarray(places, np.float32)[:, None], False, np.zeros(0)
    if len(places) >= shape[0] * shape[1]:
        flags, finder = cv2.CALIB_CB_SYMMETRIC_GRID, cv2.CirclesGridFinderParameters()
        has_grid, corners = cv2.findCirclesGrid(dots, shape[::-1], flags, None, finder)
    if not has_grid:
        raise ValueError(
            f"expected a grid of {shape[0]} x {shape[1]} markers, found {len(places)} dots that "
            "make none: start at a frame that shows all, in focus, with none covered"
        )
    return np.asarray(KDTree(places).query(corners.reshape(-1, 2))[1]).reshape(shape)


def _check_whole(places: Places, grid: np.ndarray) -> None:
    """Refuse a grid beside which another full row or column of dots lies."""
    tree = KDTree(places)
    for side in (grid, grid[::-1], grid.T, grid.T[::-1]):
        step = places[side[0]] - places[side[1]]
        distance = tree.query(places[side[0]] + step)[0]
        if (distance < 0.3 * np.linalg.norm(step, axis=1)).all():
            raise ValueError(
                f"more than one grid of {grid.shape[0]} x {grid.shape[1]} fits the dots that are "
                "seen: give the shape of the whole grid, or cut the image"
            )


def _uprightness(places: np.ndarray, grid: np.ndarray) -> float:
    """How far columns run to the right and rows downward: 2 when upright, -2 upside down."""
    along = places[grid[:, -1]].mean(axis=0) - places[grid[:, 0]].mean(axis=0)
    down = places[grid[-1]].mean(axis=0) - places[grid[0]].mean(axis=0)
    return float(along[0] / np.linalg.norm(along) + down[1] / np.linalg.norm(down))


class _State(NamedTuple):
    """Where the markers are, [px], and go, [px/frame]; of those not seen, where they should be."""

    places: np.ndarray
    velocities: np.ndarray
    seen: np.ndarray
    sizes: np.ndarray  # [px], in the first frame
    basis: np.ndarray  # smooth functions on the grid, (marker, function)


def _follow(state: _State, centres: Places, sizes: Sizes) -> _State:
    """The state at the next frame, which shows dots."""
    spacing = float(np.median(KDTree(state.places).query(state.places, 2)[0][:, 1]))
    ahead = state.places + state.velocities
    ratios = sizes, state.sizes
    match = _assign(ahead, centres, ratios, GATE * spacing, state.seen)
    # Those not matched are looked for where the others' motion would have brought them.
    motion = _motion(state, centres, match)
    if motion is not None:
        ahead = np.where((match >= 0)[:, None], ahead, state.places + motion)
    match = _assign(ahead, centres, ratios, GATE * spacing, np.ones(len(ahead), bool))
    motion = _motion(state, centres, match)
    if motion is not None:
        off = np.linalg.norm(centres[match] - state.places - motion, axis=1)
        match = np.where(off < CREDIBLE * spacing, match, -1)
    seen = match >= 0
    if 2 * seen.sum() < len(seen):
        raise ValueError(
            f"only {seen.sum()} of {len(seen)} markers are still found: the cloth is covered, or "
            f"moved by more than {GATE * spacing:.0f} px from one frame to the next"
        )
    motion = _motion(state, centres, match)
    hidden = ahead if motion is None else state.places + motion
    places = np.where(seen[:, None], centres[match], hidden)
    velocities = np.where(state.seen[:, None], places - state.places, 0.0)
    return state._replace(places=places, velocities=velocities, seen=seen)


def _assign(
    ahead: np.ndarray,
    centres: Places,
    sizes: tuple[Sizes, np.ndarray],
    farthest: float,
    wanted: np.ndarray,
) -> np.ndarray:
    """The dot of each wanted marker, -1 for none: nearest to each other, and similar in size.

    `sizes`: of the dots now, and of the markers in the first frame.
    """
    distance, nearest = KDTree(centres).query(ahead)
    back = np.asarray(KDTree(ahead).query(centres)[1])
    mutual = back[nearest] == np.arange(len(ahead))
    near = wanted & mutual & (distance < farthest)
    # A dot that is half covered is smaller than the stretch makes the others, and its centre off.
    ratio = sizes[0][nearest] / sizes[1]
    common = np.median(ratio[near]) if near.any() else 1.0
    kept = near & (np.abs(np.log(ratio / common)) < np.log(SIZE_CHANGE))
    return np.where(kept, nearest, -1)


def _smooth(shape: tuple[int, int]) -> np.ndarray:
    """Polynomials up to the second degree over the grid, (marker, function)."""
    row, column = np.meshgrid(*[np.linspace(-1, 1, n) for n in shape], indexing="ij")
    terms = [column**a * row**b for a in range(3) for b in range(3 - a)]
    return np.stack(terms, axis=-1).reshape(shape[0] * shape[1], -1)


def _motion(state: _State, centres: Places, match: np.ndarray) -> np.ndarray | None:
    """The smooth motion [px] of the grid since the frame before; None: too few are matched."""
    seen = match >= 0
    if seen.sum() < 2 * state.basis.shape[1]:
        return None
    moved = centres[match[seen]] - state.places[seen]
    weights = np.ones((len(moved), 1))
    for _ in range(3):  # a few that are wrong must not pull the others along
        fit = np.linalg.lstsq(state.basis[seen] * weights, moved * weights, rcond=None)[0]
        off = np.linalg.norm(moved - state.basis[seen] @ fit, axis=1, keepdims=True)
        weights = 1 / np.maximum(1, off / (2 * np.median(off) + 1e-3))
    return state.basis @ fit
