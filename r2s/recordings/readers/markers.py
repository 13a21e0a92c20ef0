"""Printed dots on a sheet, followed through a video: from images to metres on the table.

    tracks = track(read_grey("stretch.mp4"), shape=(9, 9))
    homography = plane_homography(corners_in_pixels, corners_in_metres)  # plane
    markers = to_metres(homography, tracks.pixels)

The centre of a dot is that of its area in the image, which a tilted camera moves off the middle of
the dot: by 0.01 px for dots of 16 px at a moderate tilt, and by the square of their size.

Images are grey, (height, width); places in them are (x, y), x to the right and y down, [px], whole
numbers at the centres of pixels. Needs OpenCV: pip install 'r2s[camera]'.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Integer
from scipy.spatial import KDTree

from r2s.extras import opencv

Places = Float[np.ndarray, "dot 2"]

CONTRAST = 0.12  # a dot differs from the cloth around it by at least this part of its brightness
ROUND = 0.6  # least ratio of a dot's width to its length, in the image
AREA_CHANGE = 1.3  # factor by which a dot may differ from the others in how its area changed
GATE = 0.4  # of the spacing: farther from its prediction a dot is another one
CREDIBLE = 0.2  # of the spacing: farther from the smooth motion of all a dot is no marker


@dataclass(frozen=True)
class Dots:
    """Dots in an image: `centres` [px] to a fraction of a pixel, `areas` [px^2]."""

    centres: Places
    areas: Float[np.ndarray, " dot"]


@dataclass(frozen=True)
class Tracks:
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

    All must be seen in the first frame, which says which is which (see `find_grid` for `origin`,
    the place [px] of the first). From frame to frame a dot goes on as it went, and must be met
    within 0.4 of the grid's spacing of there. A dot that is covered, in part too, is not seen; it
    is found again where the others, by a smooth motion of all, say that it should be. `dark`: the
    dots are darker than the cloth.

    Raises ValueError that names the frame: no frames, fewer dots than the grid has in the first
    one, fewer than half of them in a later one.
    """
    pixels, seen = [], []
    state: Any = None
    for number, image in enumerate(frames):
        try:
            state = _begin(image, shape, dark, origin) if state is None else _follow(state, image)
        except ValueError as error:
            raise ValueError(f"frame {number}: {error}") from error
        pixels.append(np.where(state.seen[:, None], state.places, np.nan))
        seen.append(state.seen)
    if not pixels:
        raise ValueError("there are no frames to track markers in")
    return Tracks(np.stack(pixels), np.stack(seen), shape)


def detect(image: np.ndarray, dark: bool = True, diameter: float | None = None) -> Dots:
    """The round dots of an image, darker (or, if not `dark`, brighter) than what is around them.

    `diameter` [px] is about that of a dot; when None, that of most of the round dots in the image.
    Each is compared with the brightness around it, so uneven light does not move its centre.
    Raises ValueError when there is no dot.
    """
    if diameter is None:
        diameter = _usual_diameter(image, dark)
    contrast = _contrast(image, dark, diameter)
    boxes, areas, near = _blobs(contrast, 0.5 * max(CONTRAST, _strength(contrast)))
    round_ = boxes.min(axis=1) >= ROUND * boxes.max(axis=1)
    full = areas >= 0.6 * np.pi / 4 * boxes.prod(axis=1)
    usual = np.pi / 4 * diameter**2
    kept = round_ & full & (areas > 0.35 * usual) & (areas < 2.5 * usual)
    if not kept.any():
        raise ValueError(f"no round dots of about {diameter:.0f} px across: is the light on?")
    return Dots(_centres(contrast, near[kept], diameter), areas[kept])


def find_grid(
    places: Places, shape: tuple[int, int], origin: tuple[float, float] | None = None
) -> Integer[np.ndarray, " marker"]:
    """Which of the dots is which of a grid of `shape` (rows, columns): an index for each, by rows.

    The grid may be turned and seen at an angle; dots that are off it are left out. Seen from above
    it is never mirrored, but dots alone do not say where it begins: its first marker is the corner
    nearest to `origin` [px], or else the one from which the columns run most to the right and the
    rows most downward. Raises ValueError when the grid is not there as a whole, or when `origin`
    is at a corner from which rows and columns have the other's length.
    """
    cells = _grow(places)
    rows, columns = shape
    window = _window(cells, shape)
    if window is None:
        found = len(cells)
        low, high = np.min(list(cells.values()), axis=0), np.max(list(cells.values()), axis=0)
        spans = " x ".join(str(n) for n in high - low + 1)
        raise ValueError(
            f"expected a grid of {rows} x {columns} markers, found {found} in one that spans "
            f"{spans}: start at a frame that shows all, in focus, with none covered"
        )
    turns = [t for k in range(4) if (t := np.rot90(window, k)).shape == shape]
    firsts = np.array([places[turn[0, 0]] for turn in turns])
    if origin is not None:
        corners = places[[window[0, 0], window[0, -1], window[-1, 0], window[-1, -1]]]
        nearest = corners[np.argmin(np.linalg.norm(corners - np.array(origin), axis=1))]
        distance = np.linalg.norm(firsts - nearest, axis=1)
        if distance.min() > 0:
            raise ValueError(
                f"from the corner at {tuple(np.round(nearest).tolist())} px the grid has not "
                f"{rows} rows and {columns} columns, seen unmirrored: swap them, or name another"
            )
        return turns[int(distance.argmin())].reshape(-1)
    upright = [_uprightness(places, turn) for turn in turns]
    return turns[int(np.argmax(upright))].reshape(-1)


# From image to dots


def _contrast(image: np.ndarray, dark: bool, diameter: float) -> np.ndarray:
    """By which part each pixel differs from the cloth around it; float32, 0 on the cloth."""
    cv2 = opencv()
    grey = np.asarray(image, np.float32) + 1
    smooth = cv2.GaussianBlur(grey, (0, 0), max(0.8, 0.1 * diameter))
    kernel = np.ones((2 * round(diameter) + 1,) * 2, np.uint8)
    # Without the dots: a closing fills the dark ones, an opening takes the bright ones away.
    operation = cv2.MORPH_CLOSE if dark else cv2.MORPH_OPEN
    cloth = cv2.blur(cv2.morphologyEx(smooth, operation, kernel), (round(diameter) | 1,) * 2)
    return (1 - smooth / cloth) if dark else (smooth / cloth - 1)


def _strength(contrast: np.ndarray) -> float:
    """The contrast inside of most dots: the middle of what stands out from the noise."""
    noise = 1.5 * float(np.median(np.abs(contrast[::4, ::4])))
    above = contrast[contrast > max(CONTRAST, 6 * noise)]
    return float(np.median(above)) if len(above) else 0.0


def _blobs(contrast: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Widths and heights, areas and middles [px] of what stands out, off the image's edges."""
    cv2 = opencv()
    above = (contrast > threshold).astype(np.uint8)
    _, _, stats, middles = cv2.connectedComponentsWithStats(above, connectivity=8)
    height, width = contrast.shape
    left, top, w, h, area = stats[1:].T
    inside = (left > 0) & (top > 0) & (left + w < width) & (top + h < height) & (area >= 5)
    boxes = np.stack([w, h], axis=1)[inside].astype(float)
    return boxes, area[inside].astype(float), middles[1:][inside]


def _usual_diameter(image: np.ndarray, dark: bool) -> float:
    """The diameter [px] that most round dots have, whatever their size."""
    best, most = 0.0, 0
    for guess in (6.0, 12.0, 24.0, 48.0, 96.0):
        if 4 * guess > min(image.shape):
            break
        contrast = _contrast(image, dark, guess)
        boxes, areas, _ = _blobs(contrast, 0.5 * max(CONTRAST, _strength(contrast)))
        if not len(areas):
            continue
        fine = (boxes.min(axis=1) >= ROUND * boxes.max(axis=1)) & (areas >= 12)
        fine &= areas >= 0.6 * np.pi / 4 * boxes.prod(axis=1)
        sizes = np.sqrt(4 / np.pi * areas[fine])
        sizes = sizes[(sizes > 0.5 * guess) & (sizes < 2.2 * guess)]
        if not len(sizes):
            continue
        alike = np.abs(np.log(sizes[:, None] / sizes)) < 0.25
        count = int(alike.sum(axis=1).max())
        if count > 1.05 * most:  # of guesses that find as many, the smallest
            best, most = float(np.median(sizes[alike[alike.sum(axis=1).argmax()]])), count
    if most == 0:
        raise ValueError("no round dots in the image: are they darker than the cloth, and in focus")
    return best


def _centres(contrast: np.ndarray, near: np.ndarray, diameter: float) -> np.ndarray:
    """Centres of the dots' contrast, in round windows that move until the dot is in the middle."""
    radius = 0.75 * diameter + 1
    reach = int(np.ceil(radius)) + 1
    steps = np.arange(-reach, reach + 1)
    padded = np.pad(contrast, reach + 1)
    centres = near.copy()
    for _ in range(4):
        middle = np.rint(centres).astype(int)
        x = middle[:, 0, None, None] + steps[None, None, :]
        y = middle[:, 1, None, None] + steps[None, :, None]
        x_there = np.clip(x + reach + 1, 0, padded.shape[1] - 1)
        y_there = np.clip(y + reach + 1, 0, padded.shape[0] - 1)
        away = np.hypot(x - centres[:, 0, None, None], y - centres[:, 1, None, None])
        edge = np.clip(radius - away + 0.5, 0, 1)  # soft: else the sums jump from pixel to pixel
        weight = np.maximum(padded[y_there, x_there], 0) * edge
        total = np.maximum(weight.sum(axis=(1, 2)), 1e-12)
        moved = [(weight * axis).sum(axis=(1, 2)) / total for axis in (x, y)]
        centres = np.stack(moved, axis=1)
    return centres


# From dots to a grid


def _grow(places: np.ndarray) -> dict[int, tuple[int, int]]:
    """The cell (row, column) of each dot of the largest grid that grows from one of the dots.

    Each step goes by the local spacing, so that turns, perspective and a stretch do no harm.
    """
    if len(places) < 4:
        raise ValueError(f"a grid needs at least four dots, found {len(places)}")
    tree = KDTree(places)
    best: dict[int, tuple[int, int]] = {}
    # From the middle outward: a seed in the grid finds all of it, a speck finds next to nothing.
    order = np.argsort(np.linalg.norm(places - np.median(places, axis=0), axis=1))
    for seed in order[:12]:
        cells = _grow_from(places, tree, int(seed))
        best = cells if len(cells) > len(best) else best
        if 2 * len(best) > len(places):
            break
    return best


def _grow_from(places: np.ndarray, tree: Any, seed: int) -> dict[int, tuple[int, int]]:
    axes = _seed_axes(places, tree, seed)
    if axes is None:
        return {seed: (0, 0)}
    cells, taken = {seed: (0, 0)}, {(0, 0): seed}
    steps = {seed: axes}  # each dot's own vectors to the next column and to the next row
    queue = [seed]
    while queue:
        here = queue.pop(0)
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            vector = steps[here][axis] * sign
            row, column = cells[here]
            cell = (row + sign, column) if axis == 1 else (row, column + sign)
            if cell in taken:
                continue
            distance, there = tree.query(places[here] + vector)
            if there in cells or distance > 0.3 * np.linalg.norm(vector):
                continue
            met = sign * (places[there] - places[here])
            own = steps[here].copy()
            own[axis] = met
            cells[int(there)], taken[cell], steps[int(there)] = cell, int(there), own
            queue.append(int(there))
    return cells


def _seed_axes(places: np.ndarray, tree: Any, seed: int) -> np.ndarray | None:
    """Vectors [px] from a dot to the next column and to the next row, or None."""
    count = min(9, len(places))
    _, near = tree.query(places[seed], count)
    vectors = places[near[1:]] - places[seed]
    first = vectors[0]
    for second in vectors[1:]:
        lengths = np.linalg.norm(first), np.linalg.norm(second)
        sine = np.cross(np.append(first, 0), np.append(second, 0))[2] / (lengths[0] * lengths[1])
        if abs(sine) > 0.7 and lengths[1] < 2.2 * lengths[0]:
            # never mirrored: rows are to columns as down is to right
            return np.array([first, second] if sine > 0 else [second, first])
    return None


def _window(cells: dict[int, tuple[int, int]], shape: tuple[int, int]) -> np.ndarray | None:
    """The dots of the one full block of `shape`, or of its transpose, among the cells."""
    low = np.min(list(cells.values()), axis=0)
    size = np.max(list(cells.values()), axis=0) - low + 1
    table = np.full(size, -1)
    for dot, cell in cells.items():
        table[tuple(np.array(cell) - low)] = dot
    for rows, columns in dict.fromkeys([shape, shape[::-1]]):
        full = [
            block
            for i in range(size[0] - rows + 1)
            for j in range(size[1] - columns + 1)
            if ((block := table[i : i + rows, j : j + columns]) >= 0).all()
        ]
        if len(full) > 1:
            raise ValueError(
                f"more than one grid of {rows} x {columns} fits the {size[0]} x {size[1]} dots "
                "that are seen: give the shape of the whole grid, or cut the image"
            )
        if full:
            return full[0]
    return None


def _uprightness(places: np.ndarray, grid: np.ndarray) -> float:
    """How far columns run to the right and rows downward: 2 when upright, -2 upside down."""
    along = places[grid[:, -1]].mean(axis=0) - places[grid[:, 0]].mean(axis=0)
    down = places[grid[-1]].mean(axis=0) - places[grid[0]].mean(axis=0)
    return float(along[0] / np.linalg.norm(along) + down[1] / np.linalg.norm(down))


# From frame to frame


@dataclass(frozen=True)
class _State:
    """Where the markers are, [px], and go, [px/frame]; of those not seen, where they should be."""

    places: np.ndarray
    velocities: np.ndarray
    areas: np.ndarray  # [px^2], in the first frame
    seen: np.ndarray
    basis: np.ndarray  # smooth functions on the grid, (marker, function)
    spacing: float  # [px]
    diameter: float  # [px]
    dark: bool


def _begin(image: np.ndarray, shape: tuple[int, int], dark: bool, origin: Any) -> _State:
    dots = detect(image, dark)
    grid = find_grid(dots.centres, shape, origin)
    places, areas = dots.centres[grid], dots.areas[grid]
    spacing = float(np.median(KDTree(places).query(places, 2)[0][:, 1]))
    diameter = float(np.sqrt(4 / np.pi * np.median(areas)))
    seen = np.ones(len(grid), bool)
    still = np.zeros_like(places)
    return _State(places, still, areas, seen, _smooth(shape), spacing, diameter, dark)


def _follow(state: _State, image: np.ndarray) -> _State:
    dots = detect(image, state.dark, state.diameter)
    ahead = state.places + state.velocities
    match = _assign(ahead, dots, state, state.seen)
    # Those that were lost are looked for where the others' motion would have brought them.
    ahead = np.where((match >= 0)[:, None], ahead, _carried(state, dots, match, ahead))
    match = _assign(ahead, dots, state, np.ones(len(ahead), bool))
    match = np.where(_credible(state, dots, match), match, -1)
    seen = match >= 0
    if 2 * seen.sum() < len(seen):
        raise ValueError(
            f"only {seen.sum()} of {len(seen)} markers are still found: the cloth is covered, or "
            f"moved by more than {GATE * state.spacing:.0f} px from one frame to the next"
        )
    hidden = _carried(state, dots, match, ahead)
    places = np.where(seen[:, None], dots.centres[match], hidden)
    spacing = float(np.median(KDTree(places).query(places, 2)[0][:, 1]))
    velocities = np.where(state.seen[:, None], places - state.places, 0.0)
    return _State(
        places, velocities, state.areas, seen, state.basis, spacing, state.diameter, state.dark
    )


def _assign(ahead: np.ndarray, dots: Dots, state: _State, wanted: np.ndarray) -> np.ndarray:
    """The dot of each wanted marker, -1 for none: each the other's nearest, and alike in size."""
    distance, nearest = KDTree(dots.centres).query(ahead)
    back = np.asarray(KDTree(ahead).query(dots.centres)[1])
    mutual = back[nearest] == np.arange(len(ahead))
    near = wanted & mutual & (distance < GATE * state.spacing)
    # A dot that is half covered is smaller than the stretch makes the others, and its centre off.
    ratio = dots.areas[nearest] / state.areas
    common = np.median(ratio[near]) if near.any() else 1.0
    kept = near & (np.abs(np.log(ratio / common)) < np.log(AREA_CHANGE))
    return np.where(kept, nearest, -1)


def _smooth(shape: tuple[int, int]) -> np.ndarray:
    """Polynomials up to the second degree over the grid, (marker, function)."""
    row, column = np.meshgrid(*[np.linspace(-1, 1, n) for n in shape], indexing="ij")
    terms = [column**a * row**b for a in range(3) for b in range(3 - a)]
    return np.stack(terms, axis=-1).reshape(shape[0] * shape[1], -1)


def _motion(state: _State, dots: Dots, match: np.ndarray) -> np.ndarray | None:
    """The smooth motion [px] of the grid since the frame before, by those that are matched."""
    seen = match >= 0
    if seen.sum() < 2 * state.basis.shape[1]:
        return None
    moved = dots.centres[match[seen]] - state.places[seen]
    weights = np.ones(len(moved))
    for _ in range(3):  # a few that are wrong must not pull the others along
        weighted = weights[:, None]
        fit = np.linalg.lstsq(state.basis[seen] * weighted, moved * weighted, rcond=None)[0]
        off = np.linalg.norm(moved - state.basis[seen] @ fit, axis=1)
        weights = 1 / np.maximum(1, off / (2 * np.median(off) + 1e-3))
    return state.basis @ fit


def _carried(state: _State, dots: Dots, match: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    motion = _motion(state, dots, match)
    return ahead if motion is None else state.places + motion


def _credible(state: _State, dots: Dots, match: np.ndarray) -> np.ndarray:
    """Which matches move nearly as the others do."""
    motion = _motion(state, dots, match)
    if motion is None:
        return match >= 0
    off = np.linalg.norm(dots.centres[match] - state.places - motion, axis=1)
    return (match >= 0) & (off < CREDIBLE * state.spacing)
