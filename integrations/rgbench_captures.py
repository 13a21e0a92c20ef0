"""Captures of RGBench: segmented PCD frames, the paths of two arms, 4 x 4 extrinsics.

The layout is described in `data_manifests/rgbench.json`. Where the arms' bases are follows the
public code (both wrappers of moved points); the page on the data has left and right the other way
round, in a frame that would be left-handed. Needs pypcd4: pip install 'r2s[pcd]'.
"""

import json
import re
from pathlib import Path

import numpy as np

from r2s.recordings.cameras import is_rotation
from r2s.recordings.clouds import numbers, read_cloud
from r2s.recordings.force_log import check_increasing, header_of, read_columns
from r2s.recordings.recording import (
    Recording,
    RecordingInfo,
    SheetPlacement,
    interpolated,
    make_recording,
)

FRAME = re.compile(r"pointcloud_(\d+(?:\.\d+)?)_segmented\.pcd")
BASES = {"left": (0.0, 0.25, 0.0), "right": (0.0, -0.25, 0.0)}  # [m], in the world
COLUMNS = ("time", "pos_x", "pos_y", "pos_z")
PATH = "{}_arm_joint_states_and_end_pose.csv"


def read_capture(
    folder: Path | str,
    sheet: SheetPlacement,
    table_height: float = 0.0,
    camera_delay: float | None = None,
) -> Recording:
    """The recording of a capture, such as `green_tshirt/green_tshirt_grasp_2025-07-19-19-14-58`.

    `sheet` is the rectangle that stands for the garment, held by the left and by the right arm, in
    this order; `table_height` [m]. `camera_delay` [s]: a cloud of the time t shows the garment at
    t + camera_delay on the arms' clock; None takes the mean time between clouds, as the authors
    do. Times count from the first sample of the left arm; clouds from before it, or from after
    either path's end, are left out.

    Raises FileNotFoundError or ValueError that names the file: what is missing, extrinsics that
    are no rigid motion, columns or values of a path, clouds that are damaged or in no frame of the
    paths, a sheet that is not held at two corners.
    """
    folder = Path(folder)
    if len(sheet.pinned) != 2:
        raise ValueError(f"{folder}: two arms hold the sheet, found {len(sheet.pinned)} corners")
    frames = _frames(folder / "segment_pcds")
    rotation, shift = _extrinsics(folder / "calibration" / "world_to_camera_transform.json")
    times, left = read_arm(folder / "joints" / PATH.format("left"), BASES["left"])
    times_right, right = read_arm(folder / "joints" / PATH.format("right"), BASES["right"])
    other = interpolated(times, times_right, right)
    start, end = times[0], min(times[-1], times_right[-1])
    stamps = np.array([stamp for stamp, _ in frames])
    delay = float(np.mean(np.diff(stamps))) if camera_delay is None else camera_delay
    kept = [(t + delay, file) for t, file in frames if start <= t and t + delay <= end]
    if not kept:
        raise ValueError(
            f"{folder}: no cloud is from the time of the arms' paths, {start:.3f} to {end:.3f} s; "
            f"clouds are from {stamps[0]:.3f} to {stamps[-1]:.3f} s: are these of one capture?"
        )
    match = re.fullmatch(r"(.+)_(fling|fold|grasp)_(.+)", folder.name)
    if not match:
        raise ValueError(f"{folder}: expected a name such as white_shirt_grasp_2025-07-19-19-14-58")
    info = RecordingInfo(
        name=folder.name,
        scenario=match[2],
        fabric=match[1],
        trial=match[3],
        source=f"RGBench, {folder}",
        frames_used=(0, len(kept) - 1),
        sheet=sheet,
        table_height=table_height,
        verified=None,
        time_offset=delay,
    )
    return make_recording(
        # rows: p_world = R^T (p_camera - t)
        [(read_cloud(file) - shift) @ rotation for _, file in kept],
        np.array([time for time, _ in kept]) - start,
        np.stack([left, other], axis=1),
        times - start,
        info,
    )


def _frames(folder: Path) -> list[tuple[float, Path]]:
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder of clouds")
    frames = {float(m[1]): p for p in folder.iterdir() if (m := FRAME.fullmatch(p.name))}
    if len(frames) < 2:
        raise FileNotFoundError(
            f"{folder}: expected clouds such as pointcloud_1752924898.25_segmented.pcd, "
            f"found {len(frames)}"
        )
    return sorted(frames.items())


def _extrinsics(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """The rotation and the shift [m] from the world to the camera."""
    try:
        matrix = numbers("the extrinsics", json.loads(file.read_text(encoding="utf-8")), 4, 4)
    except ValueError as error:
        raise ValueError(f"{file}: {error}: expected four rows of four numbers") from error
    if not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise ValueError(f"{file}: the last row must be 0, 0, 0, 1, found {matrix[3].tolist()}")
    if not is_rotation(matrix[:3, :3], 1e-3):
        raise ValueError(f"{file}: its rotation is none: rows must be orthonormal, determinant 1")
    return matrix[:3, :3], matrix[:3, 3]


def read_arm(file: Path, base: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Times [s], and places [m] in the world, of an arm's gripper, whose base is at `base`.

    Raises FileNotFoundError, or ValueError that names the file: columns or values of a path.
    """
    header = header_of(file)
    if lacking := [name for name in COLUMNS if name not in header]:
        raise ValueError(
            f"{file}: lacks the columns {', '.join(lacking)}, found {header}: make them from the "
            "joints with rgbench.csv_data of the authors"
        )
    values, lines = read_columns(file, dict.fromkeys(COLUMNS, {"": 1.0}))
    check_increasing(file, lines, values[:, 0])
    return values[:, 0], values[:, 1:] + np.array(base)
