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
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from r2s._util.files import read_json
from r2s.recordings import images
from r2s.recordings.camera_fits import fit_cameras
from r2s.recordings.cameras import DepthCamera, back_project, depth_jumps, from_world, moved, rays
from r2s.recordings.clocks import Frames, find_frames, has_table, numbered_from, places_of, times_of
from r2s.recordings.clouds import Cleaning, clean, inside, voxel_means
from r2s.recordings.recording import Recording, RecordingInfo, first_motion, make_recording
from r2s.recordings.segmentation import Segmentation, Segmenter

NAME = "cameras.json"
ROUNDED = 1e-3  # [s], of printed times: masks and depth images are of one frame that are nearer
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


class Shot(NamedTuple):
    """The images of a camera in a frame; None: there is none, or it is not read."""

    depth: Path
    mask: File
    colour: File


class Images(NamedTuple):
    """The images of a recording as they lie in its folder.

    - `times`: of the frames of all cameras, on their clock, [s].
    - `numbers`: of the frames: those in the names of images that have no times, else 0, 1, ...
    - `shots`: of each frame, by the cameras that took it.
    """

    times: Float[np.ndarray, " frame"]
    numbers: list[int]
    shots: list[dict[str, Shot]]


def find_images(folder: Path | str, rig: Rig, rate: float = 0.0, coloured: bool = False) -> Images:
    """The images in the folder of a recording, paired by their times.

    `rate` [Hz] is used where the rig has none. `coloured`: whether cameras without masks need
    colours. Raises FileNotFoundError, or ValueError that names the file or camera and frame.
    """
    folder = Path(folder)
    found: dict[str, Frames] = {}
    for name in rig.cameras:
        if not (folder / name).is_dir():
            raise FileNotFoundError(
                f"{folder / name}: no folder of the camera {name!r}, which {NAME} names: "
                "restore it, or take the camera out"
            )
        found[name] = find_frames(folder / name / "depth", images.DEPTHS)
    # all are numbered alike: from the least number of an image of any camera
    least = min((int(f.keys[0]) for f in found.values() if f.stamps is None), default=0)
    found = {name: numbered_from(frames, least) for name, frames in found.items()}
    own = {
        name: _shots(folder / name, camera, coloured and not camera.masks, found[name])
        for name, camera in rig.cameras.items()
    }
    clocks = {
        n: times_of(folder / n, frames, rig.frame_rate or rate) for n, frames in found.items()
    }
    try:
        paired = pair(clocks, rig.pair_tolerance)
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from error
    has_times = any(f.stamps is not None or has_table(folder / n) for n, f in found.items())
    numbers = [
        place if has_times else min(found[name].numbers[i] for name, i in chosen.items())
        for place, (_, chosen) in enumerate(paired)
    ]
    shots = [{name: own[name][i] for name, i in chosen.items()} for _, chosen in paired]
    return Images(np.array([time for time, _ in paired]), numbers, shots)


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
    how, path = rig.segmentation, np.asarray(gripper_path, float)
    path = path[:, None] if path.ndim == 2 else path
    knots = np.asarray(gripper_times, float) - info.time_offset  # on the clock of the cameras
    found = find_images(folder, rig, coloured=how is not None and how.colour is not None)
    if how is not None:
        what = how, info.sheet, info.table_height, path, knots, str(folder)
        segmenter = Segmenter(*what, used=used_times(found.times, info.frames_used))
    alone: list[dict[str, np.ndarray]] = []
    times, clouds = read_clouds(folder, rig, found, segmenter=segmenter, alone=alone)
    still = (times <= first_motion(knots, path).shown).tolist()
    info = with_cameras(info, rig, alone, np.isin(found.times, times), still)
    clock = times + info.time_offset
    return make_recording(clouds, clock, gripper_path, gripper_times, info, **measured)


def used_times(times: Float[np.ndarray, " frame"], used: tuple[int, int]) -> tuple[float, float]:
    """The times [s] of the first and the last frame that count."""
    first, last = np.clip(used, 0, len(times) - 1)
    return float(times[first]), float(times[last])


def with_cameras(
    info: RecordingInfo,
    rig: Rig,
    alone: Sequence[Mapping[str, Float[np.ndarray, "_ 3"]]],
    kept: Bool[np.ndarray, " image"],
    still: Sequence[bool],
    to_world: Callable[[np.ndarray], np.ndarray] = np.asarray,
) -> RecordingInfo:
    """What a recording is of, with how each camera fits, and, of known `views`, who took a frame.

    - `alone`: what each camera sees of each frame (`read_clouds`); `to_world` moves it, [m].
    - `kept`: which of the frames in the folder these are. `still`: in which the sheet is at rest.
    """
    views, names = info.views, list(rig.cameras)
    taken = tuple(tuple(map(names.index, each)) for each in alone)
    if views is not None and any(len(each) < len(names) for each in taken):
        if len(views.cameras) != len(names):
            raise ValueError(
                f"recording {info.name}: its cameras are out of phase: its views must have those "
                f"of {NAME}, {', '.join(names)}, in this order"
            )
        views = replace(views, taken=taken)
    fits = fit_cameras(rig.cameras, alone, info.sheet, to_world, still)
    used = places_of(Path(info.name), info.frames_used, np.flatnonzero(kept).tolist())
    return replace(info, camera_fits=fits, views=views, frames_used=used)


def read_clouds(
    folder: Path | str,
    rig: Rig,
    found: Images | None = None,
    watch: Callable[[Iterable[Any]], Iterable[Any]] = iter,
    segmenter: Segmenter | None = None,
    alone: list[dict[str, Float[np.ndarray, "_ 3"]]] | None = None,
) -> tuple[Float[np.ndarray, " frame"], list[Float[np.ndarray, "point 3"]]]:
    """Times [s] on the cameras' clock, and the cleaned clouds [m]; raises as `stream`.

    Frames come through `watch`, such as a bar that shows progress. What each camera sees alone,
    thinned, is appended to `alone`, frame by frame.
    """
    frames = list(watch(stream(folder, rig, found, segmenter, alone)))
    return np.array([time for time, _ in frames]), [cloud for _, cloud in frames]


def stream(
    folder: Path | str,
    rig: Rig,
    found: Images | None = None,
    segmenter: Segmenter | None = None,
    alone: list[Any] | None = None,
) -> Iterator[tuple[float, Float[np.ndarray, "point 3"]]]:
    """Time [s] and cleaned cloud [m] of one frame after the other: the images of one are in memory.

    `found`: the images, where they are known. A `segmenter` cuts the cloth out of what cameras
    without masks see, and is checked after the last frame. Frames of cameras that `may_miss` the
    fabric, and do, are left out with a warning. Raises FileNotFoundError, ImportError (names the
    extra), or ValueError that names the file or camera and frame, and what to do.
    """
    folder = Path(folder)
    masked = all(camera.masks for camera in rig.cameras.values())
    if rig.segmentation is not None and segmenter is None and not masked:
        raise ValueError(f"{folder}: a segmentation needs sheet and grippers: use rgbd_recording")
    if found is None:
        found = find_images(folder, rig, coloured=bool(segmenter and segmenter.how.colour))
    last: dict[str, bytes] = {}
    is_compared, missed = False, []
    for name, camera in rig.cameras.items():
        _check_lens(name, camera)
    for frame, (time, shots) in enumerate(zip(found.times, found.shots, strict=True)):
        parts = {name: _camera_cloud(rig, name, shot, last) for name, shot in shots.items()}
        by_camera = {name: part.points for name, part in parts.items()}
        if not is_compared and len(parts) > 1:
            is_compared = True
            _check_swapped(folder, rig, by_camera)
        points = _cloth(rig, parts, float(time), segmenter)
        cloud = clean(points, rig.clean, frame)
        if len(cloud) == 0:
            if all(rig.cameras[name].may_miss for name in shots):
                missed.append(frame)
                continue
            raise ValueError(
                f"{folder}: frame {frame} at {time:g} s: no point is left in the workspace "
                f"{rig.clean.workspace} [m]: check workspace, table and masks, or drop the frame"
            )
        if alone is not None:
            alone.append({name: voxel_means(part, THINNED) for name, part in by_camera.items()})
        yield float(time), cloud
    if missed:
        words = f"{folder}: {len(missed)} of {len(found.times)} frames show no fabric"
        if len(missed) == len(found.times):
            raise ValueError(f"{words}: check masks, workspace and may_miss")
        warnings.warn(f"{words}, the first is {missed[0]}: left out", stacklevel=2)
    if segmenter is not None:
        segmenter.check()


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


def _cloth(
    rig: Rig, seen: Mapping[str, _Seen], time: float, segmenter: Segmenter | None
) -> np.ndarray:
    """The points of the cloth: all behind masks, and what a segmenter keeps of the others."""
    points = [part.points for part in seen.values() if part.masked or segmenter is None]
    whole = {name: part for name, part in seen.items() if not part.masked}
    if segmenter is not None and whole:
        parts = list(whole.values())
        scene, colours = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
        outside = sum(part.outside for part in parts)
        may_miss = all(rig.cameras[name].may_miss for name in whole)
        points.append(scene[segmenter(scene, time, colours, outside, may_miss)])
    return np.concatenate(points)


def _shots(folder: Path, camera: DepthCamera, coloured: bool, depths: Frames) -> list[Shot]:
    """The depth images of a camera, the mask of each, and the colour image if it is read."""
    masks: Sequence[File] = [None] * len(depths.files)
    if camera.masks:
        if not (folder / "masks").is_dir():
            raise FileNotFoundError(
                f"{folder / 'masks'}: no such folder: segment the fabric (SAM 2 writes such "
                f'masks), or set "masks": false and give a segmentation in {NAME}'
            )
        masks = _same_frames(folder, "masks", depths, images.MASKS)
    colours: Sequence[File] = [None] * len(depths.files)
    if coloured:
        colours = _same_frames(folder, "colour", depths, images.COLOURS)
    return [Shot(*files) for files in zip(depths.files, masks, colours, strict=True)]


def _same_frames(folder: Path, kind: str, depths: Frames, suffixes: Collection[str]) -> list[Path]:
    """The images of a kind that belong to depth images: of the same numbers in their names, or the
    nearest times, to `ROUNDED` or a tenth of the shortest interval."""
    others, tolerance = find_frames(folder / kind, suffixes), 0.0
    if depths.stamps is not None:
        tolerance = min(ROUNDED, float(np.diff(depths.stamps).min(initial=1.0)) / 10)
    own, other = (np.array(frames.keys, float)[:, None] for frames in (depths, others))
    apart, nearest = KDTree(other).query(own)
    lacking = [depths.files[i] for i in np.flatnonzero(apart > tolerance)]
    left = [others.files[i] for i in np.setdiff1d(np.arange(len(other)), nearest)]
    for where, path in [*((kind, path) for path in lacking), *(("depth", path) for path in left)]:
        raise ValueError(
            f"{folder / where}: no image that belongs to {path}: export it again, or drop the "
            f"frame; depth and {kind} have the same numbers, or times, in their names"
        )
    return [others.files[i] for i in nearest]


def _camera_cloud(rig: Rig, name: str, shot: Shot, last: dict[str, bytes]) -> _Seen:
    """World points [m] of the fabric, or without a mask of all, that a camera sees in a frame."""
    camera, (depth_file, mask_file, colour_file) = rig.cameras[name], shot
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
    # of what a mask marks most; without one a point, where the fabric must be seen
    most, least = kept.mean() if len(points) else 1.0, 0.0 if camera.may_miss else 1e-9
    if most < (MOST if mask_file is not None else least):
        raise ValueError(
            f"{depth_file}: {most:.0%} of {len(points)} points of {name!r} are in the "
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
