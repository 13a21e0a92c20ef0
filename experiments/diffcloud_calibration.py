"""How DIFFCLOUD's cameras were calibrated, and where its clouds lie beside the tool.

python experiments/diffcloud_calibration.py recordings

`recordings` holds the public clouds and a folder `calibration`: of both cameras where they saw the
board (`*_board_in_camera.npy`) and their pose (`*_camera_to_robot.npy`), the board in the robot's
frame, and `recordings.json` with what was done to each recording. Printed: of each camera how much
too long it measures and what is left of the board's errors [mm]; of each recording how far the top
of its clouds is from the tool across [mm], once all that was done by hand is undone and the scale
is mended. The manifest of the recordings has its numbers from here.
"""

import json
from pathlib import Path

import numpy as np
from _tables import Line, command_line, keep
from scipy.spatial.transform import Rotation

CAMERAS = ("overhead", "side")
TOP, LATE = 98, range(20, 25)  # percentile of height, and frames, in which the tool is slow


def similarity(seen: np.ndarray, true: np.ndarray) -> tuple[float, np.ndarray]:
    """The scale that brings places nearest to others, and what is left of their distances [m]."""
    seen, true = seen - seen.mean(axis=0), true - true.mean(axis=0)
    turn, _ = Rotation.align_vectors(true, seen)
    there = turn.apply(seen)
    scale = float(np.sum(there * true) / np.sum(there**2))
    return scale, scale * there - true


def in_robot_frame(cloud: np.ndarray, done: dict) -> np.ndarray:
    """A cloud [m] as the cameras gave it, with what was done to it undone."""
    turn = Rotation.from_euler("z", done["rotation_about_z_degrees"], degrees=True)
    placed = turn.apply(cloud * done["scale_m"])
    return placed + np.array(done["translation_m"]) - np.array(done["compensation_m"])


def beside_tool(folder: Path, name: str, done: dict, scale: float, middle: np.ndarray) -> Line:
    """Where the tops of a recording's clouds are beside the tool, in its last frames."""
    tool = np.load(folder / f"{name.partition('_')[0]}_gripper.npy")
    away = []
    for frame in LATE:
        cloud = in_robot_frame(np.load(folder / name / f"{frame:03d}.npy"), done)
        cloud = middle + scale * (cloud - middle)
        top = cloud[cloud[:, 2] >= np.percentile(cloud[:, 2], TOP)]
        away.append(top.mean(axis=0) - tool[frame])
    x, y, z = 1e3 * np.median(away, axis=0)
    return {"of": name, "x [mm]": f"{x:.0f}", "y [mm]": f"{y:.0f}", "z [mm]": f"{z:.0f}"}


if __name__ == "__main__":
    parser = command_line(__doc__, "results/diffcloud_calibration.csv")
    parser.add_argument("recordings", type=Path)
    a = parser.parse_args()
    calibration = a.recordings / "calibration"
    board = np.load(calibration / "board_in_robot.npy")
    lines: list[Line] = []
    scales = []
    for camera in CAMERAS:
        scale, left = similarity(np.load(calibration / f"{camera}_board_in_camera.npy"), board)
        scales.append(scale)
        x, y, z = (f"{1e3 * each:.1f}" for each in np.sqrt(np.mean(left**2, axis=0)))
        line = {"of": camera, "scale": f"{scale:.4f}", "x [mm]": x, "y [mm]": y, "z [mm]": z}
        lines.append(line)
    made = json.loads((calibration / "recordings.json").read_text())
    middle, scale = board.mean(axis=0), float(np.mean(scales))
    lines += [beside_tool(a.recordings, n, done, scale, middle) for n, done in made.items()]
    title = "Cameras: what is left of the board's errors. Recordings: tops beside the tool."
    keep(a.out, lines, title)
