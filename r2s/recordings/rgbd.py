"""RGB-D recordings: folders of depth images and masks, one a camera, to clouds of the fabric.

The folder of a recording holds, for each camera that `cameras.json` names,

    NAME/depth/000.png ...   16-bit PNG, or NPY; `depth_scale` metres per unit, 0 for no depth
    NAME/masks/000.png ...   not zero where the fabric is; same numbers ("masks": false for none)
    NAME/colour/000.png ...  PNG or JPG, same numbers, in the pixels of the depth; may be missing,
                             is read where a segmentation has a colour
    NAME/times.csv           seconds, in the last column; may be missing if `frame_rate` is given

and `cameras.json` lies there, or in the folder above for all recordings of one set: the fields of
`Rig`, `Cleaning` and `DepthCamera`; docs/guide/record.md shows one.
"""

import hashlib
import itertools
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from r2s._util.files import read_json
from r2s.recordings import images
from r2s.recordings.camera_fits import fit_cameras
from r2s.recordings.cameras import DepthCamera, back_project, depth_jumps, from_world, moved, rays
from r2s.recordings.clocks import Frames, find_frames, times_of
from r2s.recordings.clouds import Cleaning, clean, inside, voxel_means
from r2s.recordings.recording import Recording, RecordingInfo, is_at_rest, make_recording
from r2s.recordings.segmentation import Segmentation, Segmenter

NAME = "cameras.json"
TOGETHER = 0.005  # [s]: frames of several cameras that are nearer in time are one frame
MOST = 0.5  # of the points behind a mask: at least so many are in the workspace
DISAGREE = 0.005  # [m]: cameras whose clouds are closer than this are not swapped
COMPARED = 2000  # points of each cloud
THINNED = 0.005  # [m], sides of the cubes to which a camera alone is thinned
File = Path | None
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def pair(
    times: Mapping[str, Float[np.ndarray, " frame"]], tolerance: float = 0.0
) -> list[tuple[float, dict[str, int]]]:
    """The time of each frame of a recording, [s], and the indices of the cameras' frames in it.

    Frames of several cameras that lie within `tolerance` [s] of the first of them are one frame, at
    their mean time; others stand alone. 0: `TOGETHER`, or a quarter of the shortest interval of a
    camera if that is less.
    """
    if tolerance == 0:
        gaps = np.concatenate([np.diff(t) for t in times.values()])
        tolerance = min(TOGETHER, float(gaps.min(initial=1.0)) / 4)
    if max(t[0] for t in times.values()) > min(t[-1] for t in times.values()) + tolerance:
        spans = ", ".join(f"{name} {t[0]:g} to {t[-1]:g} s" for name, t in times.items())
        raise ValueError(f"the cameras never ran at once: {spans}: check that they share a clock")
    events = sorted((t, name, i) for name, clock in times.items() for i, t in enumerate(clock))
    groups: list[list[tuple[float, str, int]]] = []
    for event in events:
        latest = groups[-1] if groups else []
        is_near = latest and event[0] - latest[0][0] <= tolerance
        if is_near and event[1] not in [name for _, name, _ in latest]:
            latest.append(event)
        else:
            groups.append([event])
    return [
        (float(np.mean([t for t, _, _ in group])), {name: i for _, name, i in group})
        for group in groups
    ]


@dataclass(frozen=True)
class Rig:
    """The cameras of a set of recordings, which share a clock.

    - `frame_rate`: for cameras without times.csv and without times in the names of their images,
      [Hz]; 0: all have them.
    - `pair_tolerance`: what the times of images may differ by that are one frame, [s]; 0: 5 ms, or
      a quarter of the shortest interval if that is less. Others are frames of their own.
    - `segmentation`: how the cloth is cut out of what cameras without masks see; null: it is all.
    """

    cameras: Mapping[str, DepthCamera]
    clean: Cleaning
    frame_rate: float = 0.0
    pair_tolerance: float = 0.0
    note: str = ""
    segmentation: Segmentation | None = None

    def __post_init__(self) -> None:
        if not self.cameras:
            raise ValueError("cameras: none is given")
        if self.frame_rate < 0 or self.pair_tolerance < 0:
            raise ValueError("frame_rate [Hz] and pair_tolerance [s] must not be negative")


def read_rig(folder: Path | str) -> Rig:
    """The cameras of the recording in `folder`: its own cameras.json, or that of the folder above.

    Raises FileNotFoundError, or ValueError that names the file and the field.
    """
    path = find_rig(folder)
    if path is None:
        raise FileNotFoundError(
            f"{folder}: no {NAME} there or in the folder above: write one with intrinsics, poses "
            "and depth_scale of the cameras"
        )
    return read_json(path, Rig)


def find_rig(folder: Path | str) -> Path | None:
    """Where the cameras of a recording are described, None if nowhere."""
    places = (Path(folder) / NAME, Path(folder).parent / NAME)
    return next((path for path in places if path.is_file()), None)


def rgbd_recording(
    folder: Path | str,
    info: RecordingInfo,
    gripper_path: Any,
    gripper_times: Any,
    *,
    rig: Rig | None = None,
    **measured: Any,
) -> Recording:
    """The recording in a folder of RGB-D images.

    `info.time_offset` is added to the cameras' times. `gripper_path`, `gripper_times`, `measured`
    (force, markers) and errors are as in `make_recording`; errors also as in `stream`.
    """
    rig, segmenter = rig or read_rig(folder), None
    if rig.segmentation is not None:
        path = np.asarray(gripper_path, float)
        knots = np.asarray(gripper_times, float) - info.time_offset
        what = rig.segmentation, info.sheet, info.table_height, path, knots, str(folder)
        segmenter = Segmenter(*what, frames_used=info.frames_used)
    alone: list[dict[str, np.ndarray]] = []
    times, clouds = read_clouds(folder, rig, segmenter=segmenter, alone=alone)
    path = np.asarray(gripper_path, float)
    knots, path = np.asarray(gripper_times, float), path[:, None] if path.ndim == 2 else path
    at_rest = is_at_rest(float(times[0]) + info.time_offset, knots, path)
    fits = fit_cameras(rig.cameras, alone, info.sheet, at_rest=at_rest)
    info = replace(info, camera_fits=fits)
    clock = times + info.time_offset
    return make_recording(clouds, clock, gripper_path, gripper_times, info, **measured)


def read_clouds(
    folder: Path | str,
    rig: Rig,
    frame_rate: float = 0.0,
    watch: Callable[[Iterable[Any]], Iterable[Any]] = iter,
    segmenter: Segmenter | None = None,
    alone: list[dict[str, Float[np.ndarray, "_ 3"]]] | None = None,
) -> tuple[Float[np.ndarray, " frame"], list[Float[np.ndarray, "point 3"]]]:
    """Times [s] on the cameras' clock, and the cleaned clouds [m]; raises as `stream`.

    Frames come through `watch`, such as a bar that shows progress. What each camera sees alone,
    thinned, is appended to `alone`, frame by frame.
    """
    frames = list(watch(stream(folder, rig, frame_rate, segmenter, alone)))
    return np.array([time for time, _ in frames]), [cloud for _, cloud in frames]


def stream(
    folder: Path | str,
    rig: Rig,
    frame_rate: float = 0.0,
    segmenter: Segmenter | None = None,
    alone: list[Any] | None = None,
) -> Iterator[tuple[float, Float[np.ndarray, "point 3"]]]:
    """Time [s] and cleaned cloud [m] of one frame after the other: the images of one are in memory.

    `frame_rate` [Hz] is used where the rig has none. A `segmenter` cuts the cloth out of what
    cameras without masks see, and is checked after the last frame. Raises FileNotFoundError,
    ImportError (names the extra), or ValueError that names the file or camera and frame, and what
    to do.
    """
    folder = Path(folder)
    masked = all(camera.masks for camera in rig.cameras.values())
    if rig.segmentation is not None and segmenter is None and not masked:
        raise ValueError(f"{folder}: a segmentation needs sheet and grippers: use rgbd_recording")
    coloured = bool(segmenter and segmenter.how.colour)
    first = _first_number(folder, rig)
    files = {
        name: _files(folder / name, camera, coloured and not camera.masks, first)
        for name, camera in rig.cameras.items()
    }
    depths = {name: frames for name, (frames, _, _) in files.items()}
    last: dict[str, bytes] = {}
    is_compared = False
    for name, camera in rig.cameras.items():
        _check_lens(name, camera)
    for frame, (time, chosen) in enumerate(_paired(folder, rig, depths, frame_rate)):
        parts = {}
        for name, i in chosen.items():
            frames, masks, colours = files[name]
            parts[name] = _camera_cloud(rig, name, frames.files[i], masks[i], colours[i], last)
        by_camera = {name: part.points for name, part in parts.items()}
        if not is_compared and len(parts) > 1:
            is_compared = True
            _check_swapped(folder, rig, by_camera)
        if alone is not None:
            alone.append({name: voxel_means(part, THINNED) for name, part in by_camera.items()})
        points = _cloth(list(parts.values()), time, segmenter)
        cloud = clean(points, rig.clean, frame)
        if len(cloud) == 0:
            raise ValueError(
                f"{folder}: frame {frame} at {time:g} s: no point is left in the workspace "
                f"{rig.clean.workspace} [m]: check workspace, table and masks, or drop the frame"
            )
        yield time, cloud
    if segmenter is not None:
        segmenter.check()


def frame_times(folder: Path | str, rig: Rig, frame_rate: float = 0.0) -> np.ndarray:
    """The times [s] of the frames of all cameras, as `stream` gives them."""
    first = _first_number(Path(folder), rig)
    depths = {n: find_frames(Path(folder) / n / "depth", images.DEPTHS, first) for n in rig.cameras}
    return np.array([time for time, _ in _paired(Path(folder), rig, depths, frame_rate)])


def _first_number(folder: Path, rig: Rig) -> int | None:
    """The least number of an image of any camera: all are numbered alike; None: they have times."""
    folders = [folder / name / "depth" for name in rig.cameras]
    frames = [find_frames(each, images.DEPTHS) for each in folders if each.is_dir()]
    numbers = [int(each.keys[0]) for each in frames if each.stamps is None]
    return min(numbers, default=None)


def _paired(folder: Path, rig: Rig, depths: Mapping[str, Frames], frame_rate: float):
    rate = rig.frame_rate or frame_rate
    times = {name: times_of(folder / name, frames, rate) for name, frames in depths.items()}
    try:
        return pair(times, rig.pair_tolerance)
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from error


def _check_lens(name: str, camera: DepthCamera) -> None:
    """Say which share of the pixels has no ray; refuse a camera where that is most of them."""
    lost = float(np.isnan(rays(camera)[..., 0]).mean())
    words = f"{NAME}: {name}: its lens and distortion give {lost:.1%} of the pixels no direction"
    if lost > MOST:
        raise ValueError(f'{words}: correct them ("lens": "fisheye" for numbers of cv2.fisheye)')
    if lost:
        warnings.warn(f"{words}: left out", stacklevel=3)


class _Seen(NamedTuple):
    """Points [m] of a camera in the workspace, colours if asked for, and how many are outside."""

    points: np.ndarray
    colours: np.ndarray
    outside: int
    masked: bool


def _cloth(seen: list[_Seen], time: float, segmenter: Segmenter | None) -> np.ndarray:
    """The points of the cloth: all behind masks, and what a segmenter keeps of the others."""
    points = [part.points for part in seen if part.masked or segmenter is None]
    whole = [part for part in seen if not part.masked]
    if segmenter is not None and whole:
        scene, colours = (np.concatenate([part[i] for part in whole]) for i in (0, 1))
        outside = sum(part.outside for part in whole)
        points.append(scene[segmenter(scene, time, colours, outside)])
    return np.concatenate(points)


def _files(
    folder: Path, camera: DepthCamera, coloured: bool, first: int | None
) -> tuple[Frames, list[File], list[File]]:
    """The depth images of a camera, the mask of each, and the colour image if it is read."""
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{folder}: no folder of the camera {folder.name!r}, which {NAME} names: "
            "restore it, or take the camera out"
        )
    depths = find_frames(folder / "depth", images.DEPTHS, first)
    masks: list[File] = [None] * len(depths.files)
    if camera.masks:
        if not (folder / "masks").is_dir():
            raise FileNotFoundError(
                f"{folder / 'masks'}: no such folder: segment the fabric (SAM 2 writes such "
                f'masks), or set "masks": false and give a segmentation in {NAME}'
            )
        masks = list(_same_frames(folder, "masks", depths, images.MASKS))
    colours: list[File] = [None] * len(depths.files)
    if (folder / "colour").is_dir() or coloured:
        read = _same_frames(folder, "colour", depths, images.COLOURS)
        colours = list(read) if coloured else colours
    return depths, masks, colours


def _same_frames(folder: Path, kind: str, depths: Frames, suffixes: Collection[str]) -> list[Path]:
    """The images of a kind that belong to depth images, by the numbers or times in their names."""
    others = find_frames(folder / kind, suffixes)
    one, other = (dict(zip(each.keys, each.files, strict=True)) for each in (depths, others))
    for key in sorted(one.keys() ^ other.keys()):
        lacking, path = (kind, one[key]) if key in one else ("depth", other[key])
        raise ValueError(
            f"{folder / lacking}: no image that belongs to {path}: export it again, or drop the "
            f"frame; depth and {kind} have the same numbers, or times, in their names"
        )
    return [other[key] for key in one]


def _camera_cloud(
    rig: Rig,
    name: str,
    depth_file: Path,
    mask_file: File,
    colour_file: File,
    last: dict[str, bytes],
) -> _Seen:
    """World points [m] of the fabric, or without a mask of all, that a camera sees in a frame."""
    camera = rig.cameras[name]
    depth = images.read_depth(depth_file, camera.depth_scale, camera.resolution)
    _warn_of_repeats(name, depth_file, depth, last)
    if camera.depth_along == "ray":
        depth = depth / np.sqrt(1 + (rays(camera) ** 2).sum(axis=-1))
    where = (depth > 0) & np.isfinite(rays(camera)[..., 0])
    if mask_file is not None:
        where &= _mask(name, camera, depth_file, mask_file, where)
    if rig.clean.edge > 0:
        where &= ~depth_jumps(depth, rig.clean.edge)
    seen = back_project(camera, depth, where)
    points = moved(np.array(camera.to_world), seen)
    kept = inside(points, rig.clean)
    least = MOST if mask_file is not None else 0
    if len(points) and (not kept.any() or kept.mean() < least):
        raise ValueError(
            f"{depth_file}: {kept.mean():.0%} of {len(points)} points of {name!r} are in the "
            f"workspace {rig.clean.workspace} [m], their median is at "
            f"{np.median(points, axis=0).round(3).tolist()} m: {_remedy(rig, name, seen)}"
        )
    colours = np.zeros((len(points), 3), np.uint8)
    if colour_file is not None:
        colours = images.read_colour(colour_file, camera.resolution)[where]
    return _Seen(points[kept], colours[kept], int((~kept).sum()), mask_file is not None)


def _mask(
    name: str, camera: DepthCamera, depth_file: Path, mask_file: Path, has_depth: np.ndarray
) -> np.ndarray:
    """The mask of a frame, checked against the pixels that have a depth."""
    mask = images.read_mask(mask_file, camera.resolution)
    if not mask.any() and not camera.may_miss:
        raise ValueError(
            f"{mask_file}: the mask is empty: segment the frame again, or set "
            f'"may_miss": true for {name!r} in {NAME} if the fabric was out of its view'
        )
    if mask.all():
        raise ValueError(
            f"{mask_file}: the mask marks every pixel: write 0 where the fabric is not, or set "
            f'"masks": false for {name!r} in {NAME}'
        )
    if mask.any() and not (has_depth & mask).any():
        raise ValueError(
            f"{depth_file}: no depth behind the mask {mask_file}: check that masks and depth "
            "are of one frame and in the same pixels"
        )
    return mask


def _remedy(rig: Rig, name: str, seen: Float[np.ndarray, "point 3"]) -> str:
    """Which of the usual mistakes with poses would explain points outside of the workspace."""
    pose = np.array(rig.cameras[name].to_world)
    tries = {
        "its inverse (is it world to camera?)": np.linalg.inv(pose),
        "axes that point right, up and backward (is it OpenGL's?)": pose @ OPENGL,
    }
    for other in rig.cameras.keys() - {name}:
        swapped = f"that of {other!r} (are the two swapped?)"
        tries[swapped] = np.array(rig.cameras[other].to_world)
    for words, other_pose in tries.items():
        share = inside(moved(other_pose, seen), rig.clean).mean()
        if share >= MOST:
            return f"with {words} instead of to_world, {share:.0%} would be: correct {NAME}"
    return f"check to_world, depth_scale and workspace in {NAME}"


def _check_swapped(folder: Path, rig: Rig, parts: Mapping[str, np.ndarray]) -> None:
    """Refuse poses with which two cameras disagree, though exchanged they would agree."""
    for one, other in itertools.combinations([name for name in parts if len(parts[name])], 2):
        left, right = rig.cameras[one], rig.cameras[other]
        apart = _apart(parts[one], parts[other])
        if apart < DISAGREE:
            continue
        exchanged = _apart(
            moved(np.array(right.to_world), from_world(left, parts[one])),
            moved(np.array(left.to_world), from_world(right, parts[other])),
        )
        if exchanged < apart / 2:
            raise ValueError(
                f"{folder}: the first frames of {one!r} and {other!r} are {1e3 * apart:.0f} mm "
                f"apart, with their to_world exchanged {1e3 * exchanged:.0f} mm: are the two "
                f"swapped in {NAME}?"
            )


def _apart(one: np.ndarray, other: np.ndarray) -> float:
    """Median distance [m] from the points of a cloud to the nearest of the other, both ways."""
    one, other = (points[:: len(points) // COMPARED + 1] for points in (one, other))
    both = KDTree(one).query(other)[0], KDTree(other).query(one)[0]
    return float(np.median(np.concatenate(both)))


def _warn_of_repeats(name: str, path: Path, depth: np.ndarray, last: dict[str, bytes]) -> None:
    """Warn when a camera gives the same image twice: it hung, noise alone would change it."""
    digest = hashlib.blake2b(depth.data, digest_size=16).digest()
    if last.get(name) == digest:
        warnings.warn(f"{path}: the same image as in the frame before: did it hang?", stacklevel=3)
    last[name] = digest
