"""The cloth among the points of a whole scene, for recordings without masks.

What is outside of a workspace, near the plane of the table, of another colour, near a gripper or
within an arm is cut off, in this order; of the connected pieces that are left, the largest that
touches a gripper is the cloth. In metres, z up, in the world of the recording.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import KDTree

from r2s._util.checks import SHOWN, expect
from r2s._util.extras import require
from r2s.recordings.clouds import (
    Corner,
    connected_pieces,
    draw_points,
    open_pcd,
    read_values,
    voxel_means,
)
from r2s.recordings.recording import CORNERS, SheetPlacement, corner, interpolated

FATES = ("outside", "table", "other colour", "gripper", "arm", "other pieces", "cloth")
TRIES, LOOKED_AT = 300, 3000  # planes through three points; points that vote for one
NEAR_HEIGHT, LEVEL = 0.1, np.cos(np.radians(10))  # [m] from the table's height; cosine of its tilt
FLAT, LEAST_TABLE = 0.005, 0.2  # [m] of the plane; share of the points near the height
SIDE = 15  # cells along the side of a square of the sheet's area
LEAST_AREA, MOST_AREA, FEW = 0.15, 1.15, 0.1  # seen, of the sheet's; share of frames that show less
FARTHEST, STRAY = 1.15, 0.005  # of how far the sheet reaches; share of points that may be farther
LYING = (
    "a sheet that lies on the table is cut off with what is within table_margin of it: give its "
    "colour, or masks; or, where all frames show it in the air, table_margin 0 and a workspace "
    "that begins above the table"
)
DRAWN = 4000  # points of a frame, for a picture
Points = Float[np.ndarray, "point 3"]
Colours = UInt8[np.ndarray, "colour 3"]  # red, green, blue
Which = Bool[np.ndarray, " point"]
Grippers = Float[np.ndarray, "gripper 3"]


@dataclass(frozen=True)
class Arm:
    """A cylinder around what carries a gripper.

    - `direction`: from the gripper outwards, in the world; of any length.
    - `radius`; `start`, `end`: how far from the gripper it begins and ends, [m].
    - `grippers`: the numbers of those that it belongs to, from 0; empty: all.
    """

    direction: Corner
    radius: float
    end: float
    start: float = 0.02
    grippers: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        holds = np.any(self.direction) and self.radius > 0 and self.start < self.end
        expect(holds, f"an arm needs a direction, a radius [m], and end above start: found {self}")
        expect(min(self.grippers, default=0) >= 0, f"grippers count from 0: {self.grippers}")


@dataclass(frozen=True)
class Segmentation:
    """How the cloth is cut out of a scene; lengths in metres, limits inclusive.

    - `workspace`: the box outside of which points are dropped: least and greatest corner; null:
      none. Images are cropped to that of `clean` as well.
    - `table_margin`: points within this distance of the table's plane, which is fitted to the first
      frame, are dropped, unless a `colour` is given and they have it; 0: none.
    - `colour`: least and greatest hue [0 to 360 degrees], saturation and value [0 to 1]; hues from
      340 to 20, say, are reds. null: all colours.
    - `gripper_radius`: points within this distance of a gripper are dropped; 0: none.
    - `arms`: points within them are dropped.
    - `link`: points within this distance of each other are of one piece.
    - `touch`: a piece within this distance of a gripper touches it.
    """

    workspace: tuple[Corner, Corner] | None = None
    table_margin: float = 0.0
    colour: tuple[Corner, Corner] | None = None
    gripper_radius: float = 0.0
    arms: tuple[Arm, ...] = ()
    link: float = 0.02
    touch: float = 0.06

    def __post_init__(self) -> None:
        holds = self.table_margin >= 0 < self.link and 0 <= self.gripper_radius < self.touch
        lengths = self.table_margin, self.link, self.gripper_radius, self.touch
        expect(holds, f"0 <= table_margin, 0 < link, 0 <= gripper_radius < touch, found {lengths}")
        if self.workspace is not None:
            low, high = np.array(self.workspace)
            expect((low < high).all(), f"workspace: least corner first [m], found {low}, {high}")
        if self.colour is not None:
            low, high = np.array(self.colour) / [360, 1, 1]
            holds = min(*low, *high) >= 0 and max(*low, *high) <= 1 and (low <= high)[1:].all()
            words = "colour: least and greatest hue (to 360), saturation and value (to 1), found "
            expect(holds, f"{words}{self.colour}: twice OpenCV's hue, its others over 255")


class FrameCuts(NamedTuple):
    """What became of the points of a frame.

    - `counts`: how many had each of `FATES`. `fates`: of some `points` [m], the numbers.
    - `area`, `reach`: what the cloth covers, seen from its broad side, over the sheet's area, and
      how far it goes from a gripper, over how far the sheet does.
    """

    time: float  # [s]
    counts: Int[np.ndarray, " fate"]
    points: Points
    fates: Int[np.ndarray, " point"]
    grippers: Grippers
    area: float
    reach: float


@dataclass
class Segmenter:
    """Cuts the cloth out of one frame after the other; keeps what it did in `frames`.

    - `gripper_path` [m], `gripper_times` [s]: as in `make_recording`, on the clock of the frames.
    - `to_world`: from the points as they are given to the world, [m].
    - `where`: the recording, for errors.
    - `used`: from when until when frames must show a sheet, [s]; None: all.
    - `table`: its plane, once it is fitted: normal, up, and minus the distance from 0 [m].
    """

    how: Segmentation
    sheet: SheetPlacement
    table_height: float
    gripper_path: Float[np.ndarray, "knot ..."]
    gripper_times: Float[np.ndarray, " knot"]
    where: str
    to_world: Callable[[np.ndarray], np.ndarray] = np.asarray
    used: tuple[float, float] | None = None
    frames: list[FrameCuts] = field(default_factory=list)
    table: Float[np.ndarray, "4"] | None = None

    def __call__(
        self,
        points: Points,
        time: float,
        colours: Colours | tuple[()] = (),
        outside: int = 0,
        may_miss: bool = False,
    ) -> Which:
        """Which points of the next frame are of the cloth; `outside` others were dropped before.

        Raises ValueError that names it where none is, unless it `may_miss` the cloth, or a cut
        cannot be made.
        """
        where = f"{self.where}: frame {len(self.frames)} at {time:g} s"
        try:
            return self._cut(points, time, colours, outside, may_miss)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from error

    def _cut(
        self, points: Points, time: float, colours: Any, outside: int, may_miss: bool
    ) -> Which:
        world, path = self.to_world(points), (self.gripper_times, self.gripper_path)
        grippers = interpolated(np.array([time]), *path).reshape(-1, 3)
        fates = np.full(len(points), len(FATES) - 1)
        for fate, is_cut in self._cuts(world, colours, grippers):
            fates[(fates == len(FATES) - 1) & is_cut] = FATES.index(fate)
        left = np.flatnonzero(fates == len(FATES) - 1)
        held = held_piece(world[left], grippers, self.how)
        if held.any() or self._is_used(time):
            fates[left[~held]] = FATES.index("other pieces")
        counts = np.bincount(fates, minlength=len(FATES))
        counts[0] += outside
        some = np.random.default_rng(0).permutation(len(points))[:DRAWN]
        drawn = world[some], fates[some], grippers
        is_cloth = fates == len(FATES) - 1
        if may_miss and not is_cloth.any():
            return is_cloth
        extent = _extent(world[is_cloth], grippers, self.sheet) if is_cloth.any() else (0.0, 0.0)
        self.frames.append(FrameCuts(time, counts, *drawn, *extent))
        if not is_cloth.any():
            away = np.min(np.linalg.norm(world[left, None] - grippers, axis=-1), initial=np.inf)
            raise ValueError(
                f"no cloth is left ({shares(counts)}); the nearest piece is {away:.3f} m from a "
                f"gripper, touch is {self.how.touch:g} m: widen what cuts most, check that path "
                "and frames have one clock and one world, or give masks"
            )
        return is_cloth

    def _is_used(self, time: float) -> bool:
        return self.used is None or self.used[0] <= time <= self.used[1]

    def _cuts(self, world: Points, colours: Any, grippers: Grippers) -> Iterator[tuple[str, Which]]:
        """Which points each cut takes."""
        how, other = self.how, np.full(len(world), True)
        if how.workspace is not None:
            low, high = np.array(how.workspace)
            yield "outside", ((world < low) | (world > high)).any(axis=1)
        if how.colour is not None:
            counts = f"{len(colours)} colours of {len(world)} points"
            expect(len(colours) == len(world), f"{counts}: export both again")
            other = ~in_colour(colours, how.colour)
        if how.table_margin > 0:
            if self.table is None:
                ends = [corner(self.sheet, name)[2] - self.table_height for name in CORNERS]
                expect(how.colour is not None or np.max(np.abs(ends)) >= how.table_margin, LYING)
                self.table = fit_table(world, self.table_height)
            height = world @ self.table[:3] + self.table[3]
            yield "table", other & (np.abs(height) <= how.table_margin)
        if how.colour is not None:
            yield "other colour", other
        away = world[:, None] - grippers
        yield "gripper", (np.linalg.norm(away, axis=-1) <= how.gripper_radius).any(axis=1)
        for arm in how.arms:
            axis = np.array(arm.direction) / np.linalg.norm(arm.direction)
            known = max(arm.grippers, default=0) < len(grippers)
            expect(known, f"arm of grippers {arm.grippers}: there are {len(grippers)}, from 0")
            outwards = away[:, list(arm.grippers)] if arm.grippers else away
            along = outwards @ axis
            across = np.linalg.norm(outwards - along[..., None] * axis, axis=-1)
            within = (along >= arm.start) & (along <= arm.end) & (across <= arm.radius)
            yield "arm", within.any(axis=1)

    def check(self) -> None:
        """Raise ValueError where what was left of a frame is no sheet of the stated size."""
        used = [(n, frame) for n, frame in enumerate(self.frames) if self._is_used(frame.time)]
        few = np.mean([frame.area < LEAST_AREA for _, frame in used] or [0]) <= FEW
        for number, frame in used:
            remedy = "narrow the workspace, give the colour, gripper_radius, arms, a smaller link"
            if frame.area <= MOST_AREA and frame.reach <= FARTHEST:
                remedy = "widen what cuts most, give sparse points a greater link, a sheet near the"
                remedy += " table its colour"
                if few or frame.area >= LEAST_AREA:
                    continue
            raise ValueError(
                f"{self.where}: frame {number} at {frame.time:g} s: what is left covers "
                f"{frame.area:.0%} of the sheet of {self.sheet.size} m, and goes {frame.reach:.2f} "
                f"times as far from a gripper ({shares(frame.counts)}): {remedy}, or masks"
            )


def shares(counts: Int[np.ndarray, " fate"]) -> str:
    """The share of points with each of `FATES`, for people."""
    parts = zip(FATES, counts / max(counts.sum(), 1), strict=True)
    return ", ".join(f"{name} {share:.1%}" for name, share in parts if share > 0)


def in_colour(colours: Colours, limits: tuple[Corner, Corner]) -> Which:
    """Which colours are within limits as those of `Segmentation.colour`."""
    cv2 = require("cv2", "camera", "the colour of a segmentation")
    shares = colours[None].astype(np.float32) / 255
    hsv = cv2.cvtColor(shares, cv2.COLOR_RGB2HSV)[0].astype(float)
    above, below = hsv >= np.array(limits[0]) - 1e-6, hsv <= np.array(limits[1]) + 1e-6
    if limits[0][0] > limits[1][0]:
        above[:, 0] = below[:, 0] = above[:, 0] | below[:, 0]
    return (above & below).all(axis=1)


def fit_table(points: Points, height: float) -> Float[np.ndarray, "4"]:
    """The plane with most points [m] among those that are level to 10 degrees, near a height [m].

    Normal, up, and minus its distance from 0 [m]: of random triples of points (RANSAC), then by
    least squares. Raises ValueError where none has a fifth of the points within 0.1 m of `height`.
    """
    near = draw_points(points[np.abs(points[:, 2] - height) < NEAR_HEIGHT], LOOKED_AT, (0, 0))
    problem = (
        f"no table within {NEAR_HEIGHT:g} m of z = {height:g} m: correct table_height, or, where "
        "the workspace begins above the table, set table_margin to 0"
    )
    expect(len(near) >= 3, problem)
    a, b, c = near[np.random.default_rng(0).integers(len(near), size=(3, TRIES))]
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    is_on = np.abs(near @ normals.T - (a * normals).sum(axis=1)) < FLAT
    votes = is_on.sum(axis=0) * (np.abs(normals[:, 2]) > LEVEL)
    on = near[is_on[:, votes.argmax()]]
    normal = np.linalg.svd(on - on.mean(axis=0), full_matrices=False)[2][2]
    normal *= np.sign(normal[2])
    expect(votes.max() > LEAST_TABLE * len(near) and normal[2] > LEVEL, problem)
    return np.append(normal, -normal @ on.mean(axis=0))


def held_piece(points: Points, grippers: Grippers, how: Segmentation) -> Which:
    """Which points [m] are in the largest of the pieces that touch a gripper; none if none does."""
    if not len(points):
        return np.zeros(0, bool)
    centres = voxel_means(points, how.link / 2)
    piece = connected_pieces(centres, how.link)
    away = np.linalg.norm(centres[:, None] - grippers, axis=-1).min(axis=1)
    sizes = np.bincount(piece) * (np.bincount(piece, away <= how.touch) > 0)
    return (piece[KDTree(centres).query(points)[1]] == sizes.argmax()) & (sizes.max() > 0)


def _extent(points: Points, grippers: Grippers, sheet: SheetPlacement) -> tuple[float, float]:
    """`area` and `reach` of `FrameCuts`."""
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    cell = np.sqrt(sheet.size[0] * sheet.size[1]) / SIDE
    cells = np.unique(np.floor(points @ axes[:2].T / cell), axis=0)
    # how many cells the whole sheet meets, those at its border included (Cauchy-Crofton)
    whole = SIDE**2 + 4 / np.pi * sum(sheet.size) / cell + 1
    corners = np.array([corner(sheet, name) for name in CORNERS])
    pinned = np.array([corner(sheet, name) for name in sheet.pinned])
    limits = np.linalg.norm(corners[:, None] - pinned, axis=-1).max(axis=0)
    away = np.linalg.norm(points[:, None] - grippers, axis=-1)
    return len(cells) / whole, float((np.quantile(away, 1 - STRAY, axis=0) / limits).max())


def read_colours(path: Path) -> Colours:
    """The colours of the points of a ply or pcd file; ValueError that names it without."""
    try:
        colours = _colours(path)
    except (FileNotFoundError, ImportError):
        raise
    except Exception as error:  # as in `read_values`
        words = f"{path}: its colours cannot be read: {str(error)[:SHOWN]}: copy it again"
        raise ValueError(words) from error
    if not len(colours):
        raise ValueError(
            f"{path}: its points have no colours: write ply or pcd with red, green and blue, or "
            "leave out the colour of the segmentation"
        )
    values = read_values(path)
    if len(colours) != len(values):
        raise ValueError(f"{path}: {len(values)} points, but {len(colours)} colours: copy it again")
    has_return = np.isfinite(values).any(axis=1)  # the others are no points
    return np.asarray(colours)[has_return, :3].astype(np.uint8)


def _colours(path: Path) -> Any:
    """The colours of all points of a ply or pcd file; none where it has none."""
    colours: Any = ()
    if path.suffix.lower() == ".ply":
        trimesh = require("trimesh", "study", f"{path}: clouds in ply files")
        visual = trimesh.load(path, process=False).visual
        colours = visual.vertex_colors if visual.kind == "vertex" else ()  # else it makes up grey
    elif path.suffix.lower() == ".pcd":
        cloud = open_pcd(path)
        names = [name for name in ("rgb", "rgba") if name in cloud.fields]
        colours = cloud.decode_rgb(np.atleast_1d(cloud.pc_data[names[0]]).copy()) if names else ()
    return colours
