"""Point clouds: files, frames in folders, thinning and cleaning."""

import io
import re
import warnings
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Num
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from r2s._util.checks import SHOWN
from r2s._util.extras import require

MOST_NUMBERS = 10_000  # of a point, in a field of a PCD


def numbers(what: str, values: Any, *shape: int | str) -> Float[np.ndarray, "..."]:
    """`values` as float64 of a shape, in which a name stands for any size.

    Raises ValueError that begins with `what`, also where there are none, or some are not finite.
    """
    try:
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{what}: expected an array of numbers: {str(error)[:SHOWN]}") from error
    if array.size == 0:
        raise ValueError(f"{what} is empty")
    sizes = zip(shape, array.shape, strict=False)
    fits = all(isinstance(axis, str) or axis == size for axis, size in sizes)
    if array.ndim != len(shape) or not fits:
        expected = ", ".join(map(str, shape))
        raise ValueError(f"{what} must have the shape ({expected}), found {array.shape}")
    bad = ~np.isfinite(array.reshape(len(array), -1)).all(axis=1)
    if bad.any():
        first = int(bad.argmax())
        raise ValueError(
            f"{what}: {bad.sum()} of {len(array)} are not finite, the first is number {first}: "
            f"{array[first]}"
        )
    return array


def list_frames(folder: Path | str, suffixes: Collection[str]) -> list[Path]:
    """The files of a folder with one of the `suffixes` and a number in their names, sorted.

    Raises FileNotFoundError where there are none, ValueError for several formats; both name the
    folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder")
    files = [
        path
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in suffixes
        and not path.name.startswith(".")
        and re.search("[0-9]", path.stem)
        and path.is_file()
    ]
    if not files:
        raise FileNotFoundError(
            f"{folder}: no numbered frames such as 000{next(iter(suffixes))} "
            f"(formats: {', '.join(suffixes)})"
        )
    formats = sorted({path.suffix.lower() for path in files})
    if len(formats) > 1:
        raise ValueError(f"{folder}: frames of mixed formats: {', '.join(formats)}")
    return files


def read_cloud(path: Path | str) -> Float[np.ndarray, "point 3"]:
    """The points of a file, in the file's units, as float64, in the order of the file.

    The suffix says the format: npy; ply (vertices; needs trimesh); obj (vertices); xyz (three
    columns, or six with normals or colours, parted by blanks or commas, # starts a comment); pcd
    (needs pypcd4); e57 (all scans; needs pye57). Points of which no number is finite are left out:
    so PCL and Open3D write where a camera measured nothing (`read_frames` counts them).

    Raises FileNotFoundError, ImportError (names the extra to install), or a ValueError that names
    the file and what is wrong with it.
    """
    return _returns(path, read_values(path))


def read_frames(files: Iterable[Path]) -> list[Float[np.ndarray, "point 3"]]:
    """The clouds of files, as `read_cloud`; warns, once, of points without a measurement."""
    clouds, lost, folder = [], 0, None
    for file in files:
        values, folder = read_values(file), file.parent
        clouds.append(_returns(file, values))
        lost += len(values) - len(clouds[-1])
    if lost:
        share = lost / (lost + sum(map(len, clouds)))
        warnings.warn(
            f"{folder}: {share:.1%} of the points are NaN, not measured: left out", stacklevel=2
        )
    return clouds


def _returns(path: Path | str, values: np.ndarray) -> Float[np.ndarray, "point 3"]:
    if values.ndim == 2:
        values = values[np.isfinite(values).any(axis=1)]
    try:
        return numbers("the cloud", values, "point", 3)
    except ValueError as error:
        raise ValueError(f"{path}: {error}: export the points that have a depth") from error


def read_values(path: Path | str, dtype: type | None = np.float64) -> Num[np.ndarray, "..."]:
    """The numbers of a file as a type (None: its own), unchecked; raises as `read_cloud`."""
    path = Path(path)
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        known = ", ".join(READERS)
        raise ValueError(f"{path}: unknown suffix {path.suffix!r}, expected one of {known}")
    try:
        return np.asarray(reader(path), dtype)
    except (FileNotFoundError, ImportError):
        raise
    except Exception as error:  # the libraries raise anything, from IndexError to their own types
        kind = path.suffix.lower()[1:]
        words = str(error)[:SHOWN]
        raise ValueError(f"{path}: cannot be read as {kind}: {words}: copy it again") from error


def voxel_means(points: Float[np.ndarray, "point 3"], voxel: float) -> Float[np.ndarray, "cell 3"]:
    """The mean of the points in each cube of side `voxel` (units of the points), by cell."""
    points = points.astype(np.float64)
    cells = np.floor(points / voxel).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    shape = cells.max(axis=0, initial=0) + 1
    # One number a cell sorts ten times as fast as three, where 64 bits hold it.
    if np.prod(shape.astype(float)) <= 2.0**62:
        cells = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
    _, cell, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    cell = cell.reshape(-1)
    sums = [np.bincount(cell, axis, len(counts)) for axis in points.T]
    return np.stack(sums, axis=1) / counts[:, None]


def draw_points(
    points: Float[np.ndarray, "point 3"], most: int, seed: tuple[int, int]
) -> Float[np.ndarray, "drawn 3"]:
    """At most so many of some points, drawn without repetition, in their order."""
    if len(points) <= most:
        return points
    chosen = np.random.default_rng(seed).choice(len(points), most, replace=False)
    return points[np.sort(chosen)]


def connected_pieces(
    points: Float[np.ndarray, "point 3"], link: float
) -> Int[np.ndarray, " point"]:
    """The number of the piece of each point; points closer than `link` are of one piece."""
    pairs = KDTree(points).query_pairs(link, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(points),) * 2)
    return connected_components(links, directed=False)[1]


def _read_npy(path: Path) -> np.ndarray:
    values = np.load(path, allow_pickle=False)
    if not isinstance(values, np.ndarray):
        raise ValueError("it is an archive of several arrays")
    if values.dtype.kind not in "fiu":
        raise ValueError(f"expected real numbers, found dtype {values.dtype}")
    return values


def _read_ply(path: Path) -> np.ndarray:
    trimesh = require("trimesh", "study", f"{path}: clouds in ply files")
    header, end, body = path.read_bytes().partition(b"end_header")
    promised = re.search(rb"^element vertex (\d+)", header, re.MULTILINE)
    if not header.startswith(b"ply") or promised is None:
        raise ValueError("no ply header that names vertices")
    if int(promised[1]) == 0:
        return np.zeros(0)
    # trimesh stumbles over lists of nothing
    header = re.sub(rb"element (?!vertex)\S+ 0\s*\n(property .*\n)*", b"", header)
    # process, fix_texture: else vertices are merged and reordered, and doubled at seams of textures
    mesh: Any = trimesh.load(
        io.BytesIO(header + end + body), file_type="ply", process=False, fix_texture=False
    )
    vertices = np.asarray(getattr(mesh, "vertices", ()))
    if len(vertices) != int(promised[1]):
        raise ValueError(f"the header promises {int(promised[1])} vertices, found {len(vertices)}")
    return vertices


def _read_obj(path: Path) -> np.ndarray:
    # By hand: trimesh drops the vertices that no face uses and repeats others.
    lines = (line.split() for line in path.read_text(errors="replace").splitlines())
    return np.array([line[1:4] for line in lines if line[:1] == ["v"]], np.float64)


def _read_xyz(path: Path) -> np.ndarray:
    with warnings.catch_warnings(action="ignore"):  # an empty file is an error of its own
        values = np.loadtxt(path.read_text().replace(",", " ").splitlines(), ndmin=2)
    return values[:, :3] if values.shape[1] == 6 else values  # normals or colours follow


def open_pcd(path: Path) -> Any:
    """A cloud of pypcd4, which holds as many points as its header promises.

    Raises FileNotFoundError, ImportError, ValueError, or anything that pypcd4 raises.
    """
    if not path.is_file():  # before pypcd4, which wraps this error
        raise FileNotFoundError(f"{path}: no such file")
    reader = require("pypcd4", "pcd", f"{path}: clouds in pcd files").PointCloud
    data = path.read_bytes()
    counts = re.search(rb"^COUNT\s+(.*)$", data, re.MULTILINE)
    for count in counts[1].split() if counts else ():
        if int(count) > MOST_NUMBERS:  # pypcd4 makes a name for each of them
            raise ValueError(f"a field has {count[:20].decode()} numbers a point")
    if re.search(rb"^DATA\s+ascii", data, re.MULTILINE):  # pypcd4 stumbles over blanks at line ends
        data = b"\n".join(b" ".join(line.split()) for line in data.splitlines() if line.strip())
    cloud = reader.from_fileobj(io.BytesIO(data))
    found = cloud.pc_data.size
    if found != cloud.points:
        raise ValueError(f"the header promises {cloud.points} points, found {found}")
    return cloud


def _read_pcd(path: Path) -> np.ndarray:
    return open_pcd(path).numpy(("x", "y", "z"))


def _read_e57(path: Path) -> np.ndarray:
    """All scans of a file, in its world, but for points that are marked invalid."""
    path.open("rb").close()  # so that a missing file is named
    with require("pye57", "e57", f"{path}: clouds in e57 files").E57(str(path)) as file:
        scans = [file.read_scan(i, ignore_missing_fields=True) for i in range(file.scan_count)]
    axes = [[scan[f"cartesian{axis}"] for axis in "XYZ"] for scan in scans]
    return np.concatenate([np.stack(each, axis=1) for each in axes])


READERS: dict[str, Callable[[Path], np.ndarray]] = {
    ".npy": _read_npy,
    ".ply": _read_ply,
    ".obj": _read_obj,
    ".xyz": _read_xyz,
    ".pcd": _read_pcd,
    ".e57": _read_e57,
}


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
    """Which points of a thinned cloud are much farther from their neighbours than the average."""
    if neighbours == 0 or len(points) <= neighbours:
        return np.zeros(len(points), bool)
    apart = KDTree(points).query(points, neighbours + 1)[0][:, 1:].mean(axis=1)
    return apart > apart.mean() + deviations * apart.std()
