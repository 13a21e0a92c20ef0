"""How cameras were calibrated with a board, and where clouds lie beside a tool."""

from pathlib import Path

import numpy as np
from _tables import Line
from scipy.spatial.transform import Rotation

TOP, LATE = 98, range(20, 25)  # percentile of height, and frames, in which the tool is slow


def similarity(seen: np.ndarray, true: np.ndarray) -> tuple[float, np.ndarray]:
    """The scale that brings places nearest to others, and what is left of their distances [m]."""
    seen, true = seen - seen.mean(axis=0), true - true.mean(axis=0)
    turn = Rotation.align_vectors(true, seen)[0]
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
