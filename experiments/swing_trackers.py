"""How much the tracker of swings jitters while the sheet rests, row by row from the bar down.

python experiments/swing_trackers.py swings

Of each recording the standard deviation of a coordinate [mm] over the frames before its tool moves
(2 mm or 0.01 rad); last their root mean square, which the manifest of the swings has.
"""

from pathlib import Path

import numpy as np
from _tables import Line, command_line, keep
from scipy.spatial.transform import Rotation

from r2s.recordings.datasets import known_bar

MOVED, TURNED = 2e-3, 1e-2  # [m], [rad]


def jitter(file: Path, lag: float) -> np.ndarray:
    """Standard deviation [m] of a coordinate of each row."""
    with np.load(file) as arrays:
        position, quaternion = arrays["tool_position"], arrays["tool_quaternion_xyzw"]
        tool, times, points = arrays["tool_times"], arrays["times"], arrays["points"]
    turn = Rotation.from_quat(quaternion)
    moves = np.linalg.norm(position - position[0], axis=1) > MOVED
    moves |= (turn[0].inv() * turn).magnitude() > TURNED
    rest = points[times - lag < tool[np.argmax(moves)]]
    return np.sqrt(np.nanmean(np.nanstd(rest, axis=0, ddof=1) ** 2, axis=(0, 2)))


if __name__ == "__main__":
    parser = command_line(__doc__, "results/swing_trackers.csv")
    parser.add_argument("recordings", type=Path)
    a = parser.parse_args()
    files = sorted(a.recordings.glob("*.npz"))
    rows = np.array([jitter(file, known_bar().lag) for file in files])
    named = [*zip([file.stem for file in files], rows, strict=True)]
    named.append(("root mean square", np.sqrt(np.mean(rows**2, axis=0))))
    lines: list[Line] = []
    for name, row in named:
        cells = {f"row {i}": f"{1e3 * value:.1f}" for i, value in enumerate(row, 1)}
        lines.append({"swing": name} | cells)
    keep(a.out, lines, "Deviation of a coordinate of the tracked points at rest [mm].")
