"""From all that cameras saw to points of the fabric: crop, outliers, table, thinning."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from r2s.recordings.readers.clouds import draw_points, voxel_means

Corner = tuple[float, float, float]


@dataclass(frozen=True)
class Cleaning:
    """How a cloud is cleaned, in this order.

    - `workspace`: the box [m] outside of which points are dropped: least and greatest corner.
    - `edge`: pixels are dropped where depth jumps by more than this to a neighbour, [m]; 0: none.
    - `table`: height of the table and the distance from it within which points are dropped, [m];
      empty: none.
    - `voxel`: the points of each cube of this side become their mean, [m]; 0: all points are kept.
    - `neighbours`, `deviations`: a point is an outlier where its mean distance from this many
      neighbours is above the mean of all by this many standard deviations; 0 neighbours: none is.
    - `max_points`, `seed`: at most so many points a frame are drawn at random; 0: all.

    Raises ValueError for a box without inside and for numbers that are negative.
    """

    workspace: tuple[Corner, Corner]
    edge: float = 0.02
    table: tuple[float, ...] = ()
    voxel: float = 0.005
    neighbours: int = 8
    deviations: float = 3.0
    max_points: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        low, high = np.array(self.workspace)
        if not (low < high).all():
            raise ValueError(f"workspace must be [least, greatest] corner [m], found {low}, {high}")
        if len(self.table) not in (0, 2):
            raise ValueError(f"table must be [height, margin] in metres, found {self.table}")
        for name in ("edge", "voxel", "neighbours", "deviations", "max_points"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, found {getattr(self, name)}")


def clean(
    points: Float[np.ndarray, "point 3"], how: Cleaning, frame: int
) -> Float[np.ndarray, "kept 3"]:
    """The points [m] of the fabric among those of a frame; `frame` seeds the choice."""
    points = points[inside(points, how)]
    if how.table:
        points = points[np.abs(points[:, 2] - how.table[0]) > how.table[1]]
    if how.voxel > 0 and len(points):
        points = voxel_means(points, how.voxel)
    points = points[~outliers(points, how.neighbours, how.deviations)]
    return draw_points(points, how.max_points or len(points), (how.seed, frame))


def inside(points: Float[np.ndarray, "point 3"], how: Cleaning) -> Bool[np.ndarray, " point"]:
    """Which points [m] are in the workspace."""
    low, high = np.array(how.workspace)
    return ((points >= low) & (points <= high)).all(axis=1)


def outliers(
    points: Float[np.ndarray, "point 3"], neighbours: int, deviations: float
) -> Bool[np.ndarray, " point"]:
    """Which points are much farther from their nearest neighbours than points are on average.

    None is where there are no more points than `neighbours`. Points that lie where others do
    count as neighbours; thin the cloud first.
    """
    if neighbours == 0 or len(points) <= neighbours:
        return np.zeros(len(points), bool)
    apart = KDTree(points).query(points, neighbours + 1)[0][:, 1:].mean(axis=1)
    return apart > apart.mean() + deviations * apart.std()
