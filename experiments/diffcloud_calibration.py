"""How DIFFCLOUD's cameras were calibrated, and where its clouds lie beside the tool.

python experiments/diffcloud_calibration.py recordings

`recordings/calibration` holds where both cameras saw the board (`*_board_in_camera.npy`), the board
in the robot's frame, and `recordings.json` with what was done to each recording. Printed: of each
camera how much too long it measures and what is left of the board's errors [mm]; of each recording
how far the tops of its clouds are from the tool [mm], once what was done by hand is undone and the
scale is mended. The manifest has its numbers from here.
"""

import json
from pathlib import Path

import numpy as np
from _calibration import beside_tool, similarity
from _tables import Line, command_line, keep

CAMERAS = ("overhead", "side")

if __name__ == "__main__":
    parser = command_line(__doc__, "results/diffcloud_calibration.csv")
    parser.add_argument("recordings", type=Path)
    a = parser.parse_args()
    calibration = a.recordings / "calibration"
    board = np.load(calibration / "board_in_robot.npy")
    found = {
        n: similarity(np.load(calibration / f"{n}_board_in_camera.npy"), board) for n in CAMERAS
    }
    lines: list[Line] = []
    for name, (scale, left) in found.items():
        x, y, z = (f"{1e3 * each:.1f}" for each in np.sqrt(np.mean(left**2, axis=0)))
        lines.append({"of": name, "scale": f"{scale:.4f}", "x [mm]": x, "y [mm]": y, "z [mm]": z})
    made = json.loads((calibration / "recordings.json").read_text())
    middle, scale = board.mean(axis=0), float(np.mean([each for each, _ in found.values()]))
    lines += [beside_tool(a.recordings, n, done, scale, middle) for n, done in made.items()]
    title = "Cameras: what is left of the board's errors. Recordings: tops beside the tool."
    keep(a.out, lines, title)
