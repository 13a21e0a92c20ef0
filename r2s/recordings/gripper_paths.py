"""Paths of grippers with times of their own: CSV, TUM, NPZ and JSON files, and plain arrays."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from r2s._util.files import load_json, read_npz
from r2s.recordings.clouds import numbers, read_values
from r2s.recordings.force_log import (
    METRES,
    SECONDS,
    check_increasing,
    header_of,
    read_columns,
)

TIMES = ("time", "t", "timestamp", "stamp")  # titles of the column of times
LENGTHS = {"": 1.0, **METRES}  # units of positions; "": those of the file's transform
UNITLESS = {"": 1.0, "-": 1.0}
TEXT = (".csv", ".txt", ".tum")
FORMATS = (".npy", ".csv", ".txt", ".tum", ".npz", ".json")
SAME = 1e-5  # [s]: knots of several grippers that are nearer in time are one
SLOWEST = 5.0  # [s] between knots of a track: above, its times are in milliseconds or less
TURN = np.radians(2)  # between knots: above, knots are put in between
ORDERS = {"xyzw": [0, 1, 2, 3], "wxyz": [1, 2, 3, 0]}  # where x, y, z, w are


class Track(NamedTuple):
    """Where grippers went, in the units and the frame of a file.

    - `times`: of the knots, [s]; None: the file has none.
    - `positions`; `turns`: from a tool's axes to the file's, of a single gripper; None: not there.
    """

    times: Float[np.ndarray, " knot"] | None
    positions: Float[np.ndarray, "knot gripper 3"]
    turns: Rotation | None = None


def read_track(path: Path, order: str = "") -> Track:
    """Read the path of a gripper by the suffix of its file.

    - npy: (knot, 3) or (knot, gripper, 3), without times.
    - csv: titles `time` (or t, timestamp, stamp) with a unit, as in "time [s]", x, y, z (a unit
      here is taken to metres), and where known qx, qy, qz, qw.
    - txt, tum: as the TUM benchmark has it, "time x y z qx qy qz qw"; the last four may lack.
    - npz, json: `times`, `positions` and, where known, `quaternions` (knot, 4).

    `order`: of the quaternions of npz and json, "xyzw" or "wxyz". Raises FileNotFoundError, or
    ValueError that names the file and what is wrong with it.
    """
    suffix = path.suffix.lower()
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file, which gripper.file names")
    if suffix not in FORMATS:
        raise ValueError(f"{path}: unknown suffix {suffix!r}, expected one of {', '.join(FORMATS)}")
    try:
        if suffix == ".npy":
            values = read_values(path)
            return Track(None, _positions(values))
        if suffix == ".csv":
            times, positions, quaternions = _of_csv(path)
        elif suffix in TEXT:
            times, positions, quaternions = _of_text(path)
        else:
            times, positions, quaternions = _of_arrays(path, order)
    except ValueError as error:
        words = str(error)
        raise ValueError(words if words.startswith(str(path)) else f"{path}: {words}") from error
    check_increasing(path, list(range(1, len(times) + 1)), times)
    apart = float(np.median(np.diff(times))) if len(times) > 2 else 0.0
    if apart > SLOWEST:
        words = "give times in seconds, not in milliseconds or nanoseconds"
        raise ValueError(f"{path}: knots are {apart:g} s apart: {words}")
    return Track(times, positions, None if quaternions is None else _turns(path, quaternions))


def with_tool(track: Track, offset: tuple[float, float, float]) -> tuple[Track, np.ndarray]:
    """The track with knots between which the tool turns by `TURN` at most (slerp), and what an
    `offset` in the tool's axes is in those of the file (knot, 1, 3), in its unit."""
    if track.turns is None:
        raise ValueError("tool_offset needs the tool's orientation: the file has no quaternions")
    turns, count = track.turns, len(track.positions)
    angles = (turns[1:] * turns[:-1].inv()).magnitude()
    parts = np.maximum(np.ceil(angles / TURN).astype(int), 1)
    places = np.concatenate([i + np.arange(n) / n for i, n in enumerate(parts)] + [[count - 1.0]])
    knots, times = np.arange(count), track.times
    if count > 1:
        turns = Slerp(knots, turns)(places)
    flat = track.positions.reshape(count, -1)
    positions = np.stack([np.interp(places, knots, column) for column in flat.T], axis=1)
    finer = Track(
        None if times is None else np.interp(places, knots, times),
        positions.reshape(-1, *track.positions.shape[1:]),
        turns,
    )
    return finer, turns.apply(np.asarray(offset, float))[:, None]


def merged(tracks: list[Track]) -> Track:
    """One track of several grippers, at the knots of all of them; each rests before and after its
    own. Raises ValueError where only some have times, or arrays differ in length."""
    if len(tracks) == 1:
        return tracks[0]
    timed = [track.times for track in tracks if track.times is not None]
    if len(timed) not in (0, len(tracks)):
        raise ValueError("some of the grippers' files have times, others have none")
    if not timed:
        lengths = {len(track.positions) for track in tracks}
        if len(lengths) > 1:
            raise ValueError(f"the grippers' files have {sorted(lengths)} knots, and no times")
        return Track(None, np.concatenate([track.positions for track in tracks], axis=1))
    times = np.sort(np.concatenate(timed))
    times = times[np.append(True, np.diff(times) > SAME)]
    columns = [
        np.stack([np.interp(times, own, axis) for axis in track.positions[:, i].T], axis=1)
        for own, track in zip(timed, tracks, strict=True)
        for i in range(track.positions.shape[1])
    ]
    return Track(times, np.stack(columns, axis=1))


def _of_csv(path: Path):
    titles = [title.lower() for title in header_of(path)]
    time = next((t for t in TIMES if any(title.startswith(t) for title in titles)), "time")
    has_turns = any(title.startswith("qx") for title in titles)
    names = {time: SECONDS, "x": LENGTHS, "y": LENGTHS, "z": LENGTHS}
    if has_turns:
        names |= dict.fromkeys(("qx", "qy", "qz", "qw"), UNITLESS)
    values, _ = read_columns(path, names)
    return values[:, 0], values[:, None, 1:4], values[:, 4:] if has_turns else None


def _of_text(path: Path):
    try:
        values = np.loadtxt(path, ndmin=2)
    except ValueError as error:
        raise ValueError(f"no lines 'time x y z qx qy qz qw' of numbers: {error}") from error
    if values.shape[1] not in (4, 8):
        raise ValueError(
            f"expected 4 or 8 numbers a line (time x y z qx qy qz qw), found {values.shape[1]}"
        )
    values = numbers("the track", values, "knot", values.shape[1])
    return values[:, 0], values[:, None, 1:4], values[:, 4:] if values.shape[1] == 8 else None


def _of_arrays(path: Path, order: str):
    if path.suffix.lower() == ".npz":
        stored = read_npz(path, "times", "positions")
    else:
        stored = load_json(path)
        if not isinstance(stored, dict) or not {"times", "positions"} <= stored.keys():
            raise ValueError("expected an object with times and positions")
    positions = _positions(stored["positions"])
    times = numbers("times [s]", stored["times"], len(positions))
    quaternions = stored.get("quaternions")
    if quaternions is None:
        return times, positions, None
    if order not in ORDERS:
        raise ValueError('it has quaternions: say their quaternion_order, "xyzw" or "wxyz"')
    quaternions = numbers("quaternions", quaternions, len(positions), 4)
    return times, positions, quaternions[:, ORDERS[order]]


def _positions(values) -> np.ndarray:
    try:
        axes = np.ndim(values)  # ValueError where rows differ in length
        values = numbers("the path", values, "knot", *["gripper"] * (axes - 2), 3)
    except ValueError as error:
        raise ValueError(f"{error}: expected (knot, 3) or (knot, gripper, 3)") from error
    return values[:, None] if values.ndim == 2 else values


def _turns(path: Path, quaternions: np.ndarray) -> Rotation:
    lengths = np.linalg.norm(quaternions, axis=1)
    for at in np.flatnonzero(np.abs(lengths - 1) > 0.01)[:1]:
        raise ValueError(
            f"{path}: knot {at}: a quaternion of length {lengths[at]:.3g}, expected 1: are the "
            "columns qx qy qz qw in this order?"
        )
    return Rotation.from_quat(quaternions)
