"""RGB-D recordings: folders of depth images and masks, one a camera, to clouds of the fabric.

The folder of a recording holds, for each camera that `cameras.json` names,

    NAME/depth/000.png ...   16-bit PNG, or NPY; `depth_scale` metres per unit, 0 for no depth
    NAME/masks/000.png ...   not zero where the fabric is; same numbers ("masks": false for none)
    NAME/colour/000.png ...  PNG or JPG, same numbers; may be missing, is not read
    NAME/times.csv           seconds, in the last column; may be missing if `frame_rate` is given

and `cameras.json` lies there, or in the folder above for all recordings of one set: the fields of
`Rig`, `Cleaning` and `DepthCamera`; docs/guide/record.md shows one.
"""

import hashlib
import itertools
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from r2s._util.files import read_json
from r2s.recordings import images
from r2s.recordings.camera_fits import fit_cameras
from r2s.recordings.cameras import DepthCamera, back_project, depth_jumps, from_world, moved, rays
from r2s.recordings.clouds import Cleaning, clean, find_numbered, inside, voxel_means
from r2s.recordings.force_log import check_increasing, number_in, read_lines
from r2s.recordings.recording import Recording, RecordingInfo, make_recording

NAME = "cameras.json"
LONGEST = 5.0  # [s] between frames: above, times are taken for milliseconds or nanoseconds
MOST = 0.5  # of the points behind a mask: at least so many are in the workspace
DISAGREE = 0.005  # [m]: cameras whose clouds are closer than this are not swapped
COMPARED = 2000  # points of each cloud
THINNED = 0.005  # [m], sides of the cubes to which a camera alone is thinned
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def frame_times(folder: Path, count: int, frame_rate: float) -> Float[np.ndarray, " frame"]:
    """The times [s] of the frames of a camera: its times.csv, else by a frame rate [Hz].

    Raises FileNotFoundError where there is neither, or ValueError as `read_times`.
    """
    path = folder / "times.csv"
    if path.is_file():
        times = read_times(path)
        if len(times) != count:
            raise ValueError(
                f"{path}: {len(times)} times, but {count} frames in {folder / 'depth'}: "
                "one line a frame"
            )
        return times
    if frame_rate > 0:
        return np.arange(count) / frame_rate
    raise FileNotFoundError(f"{path}: no such file, and no frame_rate in {NAME}: give either")


def read_times(path: Path) -> Float[np.ndarray, " frame"]:
    """The frames' times [s] from the last column of a CSV file; a line of titles may come first.

    Raises FileNotFoundError, or ValueError that names the file and the line.
    """
    rows = read_lines(path)
    if rows and re.match("[A-Za-z]", rows[0][1][-1]):
        rows = rows[1:]
    times = np.array([number_in(path, line, cells[-1], "a time [s] last") for line, cells in rows])
    if len(times) == 0:
        raise ValueError(f"{path}: no times: expected one line a frame, its time [s] last")
    check_increasing(path, [line for line, _ in rows], times)
    interval = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    if interval > LONGEST:
        raise ValueError(
            f"{path}: frames are {interval:g} s apart: give times in seconds, not in milliseconds "
            "or nanoseconds"
        )
    return times


def pair(
    times: Mapping[str, Float[np.ndarray, " frame"]], tolerance: float
) -> dict[str, Int[np.ndarray, " pair"]]:
    """For each camera the indices of its frames, one a pair, nearest in time [s] to the first's.

    Frames of the first camera before or after the others ran are left out. `tolerance` is what
    times of a pair may differ by [s], 0 for half the interval of the first camera. Raises
    ValueError that names camera, frame and time where none is near enough, or none ran at once.
    """
    first, clock = next(iter(times.items()))
    if tolerance == 0:
        tolerance = float(np.median(np.diff(clock)) / 2) if len(clock) > 1 else 0.0
    start = max(t[0] for t in times.values()) - tolerance
    end = min(t[-1] for t in times.values()) + tolerance
    used = np.flatnonzero((clock >= start) & (clock <= end))
    if len(used) == 0:
        spans = ", ".join(f"{name} {t[0]:g} to {t[-1]:g} s" for name, t in times.items())
        raise ValueError(f"the cameras never ran at once: {spans}: check that they share a clock")
    pairs = {}
    for name, other in times.items():
        pairs[name] = np.abs(other[None] - clock[used, None]).argmin(axis=1)
        apart = np.abs(other[pairs[name]] - clock[used])
        if (apart > tolerance * (1 + 1e-9)).any():
            at = int(apart.argmax())
            raise ValueError(
                f"frame {used[at]} of {first} at {clock[used[at]]:g} s has no frame of {name} "
                f"within {tolerance:g} s, the nearest is at {other[pairs[name][at]]:g} s: restore "
                "the frame, or raise pair_tolerance"
            )
    return pairs


@dataclass(frozen=True)
class Rig:
    """The cameras of a set of recordings; the first is the clock of the others.

    - `frame_rate`: for cameras without times.csv, [Hz]; 0: all have one.
    - `pair_tolerance`: what the times of frames that belong together may differ by, [s]; 0: half
      the interval between the first camera's frames.
    """

    cameras: Mapping[str, DepthCamera]
    clean: Cleaning
    frame_rate: float = 0.0
    pair_tolerance: float = 0.0
    note: str = ""

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
    rig, alone = rig or read_rig(folder), []
    times, clouds = read_clouds(folder, rig, alone=alone)
    info = replace(info, camera_fits=fit_cameras(rig.cameras, alone, info.sheet))
    clock = times + info.time_offset
    return make_recording(clouds, clock, gripper_path, gripper_times, info, **measured)


def read_clouds(
    folder: Path | str,
    rig: Rig,
    frame_rate: float = 0.0,
    watch: Callable[[Iterable[Any]], Iterable[Any]] = iter,
    alone: list[dict[str, Float[np.ndarray, "_ 3"]]] | None = None,
) -> tuple[Float[np.ndarray, " frame"], list[Float[np.ndarray, "point 3"]]]:
    """Times [s] on the cameras' clock, and the cleaned clouds [m]; raises as `stream`.

    Frames come through `watch`, such as a bar that shows progress. What each camera sees alone,
    thinned, is appended to `alone`, frame by frame.
    """
    frames = list(watch(stream(folder, rig, frame_rate, alone)))
    return np.array([time for time, _ in frames]), [cloud for _, cloud in frames]


def stream(
    folder: Path | str, rig: Rig, frame_rate: float = 0.0, alone: list[Any] | None = None
) -> Iterator[tuple[float, Float[np.ndarray, "point 3"]]]:
    """Time [s] and cleaned cloud [m] of one frame after the other: the images of one are in memory.

    `frame_rate` [Hz] is used where the rig has none. Raises FileNotFoundError, ImportError (names
    the extra), or ValueError that names the file or camera and frame, and what to do.
    """
    folder = Path(folder)
    rate = rig.frame_rate or frame_rate
    files = {name: _files(folder / name, camera) for name, camera in rig.cameras.items()}
    times = {name: frame_times(folder / name, len(files[name]), rate) for name in rig.cameras}
    try:
        pairs = pair(times, rig.pair_tolerance)
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from error
    clock = next(iter(times.values()))
    last: dict[str, bytes] = {}
    for name, camera in rig.cameras.items():
        _check_lens(name, camera)
    for frame, index in enumerate(next(iter(pairs.values()))):
        parts = {}
        for name, chosen in pairs.items():
            depth_file, mask_file = files[name][chosen[frame]]
            parts[name] = _camera_cloud(rig, name, depth_file, mask_file, last)
        if frame == 0:
            _check_swapped(folder, rig, parts)
        if alone is not None:
            alone.append({name: voxel_means(part, THINNED) for name, part in parts.items()})
        cloud = clean(np.concatenate(list(parts.values())), rig.clean, frame)
        if len(cloud) == 0:
            raise ValueError(
                f"{folder}: frame {index} at {clock[index]:g} s: no point is left in the workspace "
                f"{rig.clean.workspace} [m]: check workspace, table and masks, or drop the frame"
            )
        yield float(clock[index]), cloud


def _check_lens(name: str, camera: DepthCamera) -> None:
    """Say which share of the pixels has no ray; refuse a camera where that is most of them."""
    lost = float(np.isnan(rays(camera)[..., 0]).mean())
    words = f"{NAME}: {name}: its lens and distortion give {lost:.1%} of the pixels no direction"
    if lost > MOST:
        raise ValueError(f'{words}: correct them ("lens": "fisheye" for numbers of cv2.fisheye)')
    if lost:
        warnings.warn(f"{words}: left out", stacklevel=3)


def _files(folder: Path, camera: DepthCamera) -> list[tuple[Path, Path | None]]:
    """The depth image and the mask of each frame of a camera."""
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{folder}: no folder of the camera {folder.name!r}, which {NAME} names: "
            "restore it, or take the camera out"
        )
    depths = find_numbered(folder / "depth", images.DEPTHS)
    masks: Mapping[int, Path | None] = dict.fromkeys(depths)
    if camera.masks:
        if not (folder / "masks").is_dir():
            raise FileNotFoundError(
                f"{folder / 'masks'}: no such folder: segment the fabric (SAM 2 writes such "
                f'masks), or set "masks": false in {NAME}'
            )
        masks = find_numbered(folder / "masks", images.MASKS)
        _same_frames(folder, "masks", depths, masks)
    if (folder / "colour").is_dir():
        _same_frames(folder, "colour", depths, find_numbered(folder / "colour", images.COLOURS))
    return [(depths[number], masks[number]) for number in depths]


def _same_frames(folder: Path, kind: str, depths: Mapping[int, Any], others: Mapping) -> None:
    for number in sorted(depths.keys() ^ others.keys()):
        lacking, path = (kind, depths[number]) if number in depths else ("depth", others[number])
        raise ValueError(
            f"{folder / lacking}: frame {number} is missing, but {path} exists: export it again, "
            f"or drop the frame; depth and {kind} have the same numbers"
        )


def _camera_cloud(
    rig: Rig, name: str, depth_file: Path, mask_file: Path | None, last: dict[str, bytes]
) -> Float[np.ndarray, "point 3"]:
    """World points [m] of the fabric that one camera sees in one frame."""
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
    return points[kept]


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
