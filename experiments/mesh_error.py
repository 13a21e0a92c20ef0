"""How far is a coarse sheet from a fine one? By motion, fabric, elements and vertices a side.

python experiments/mesh_error.py --fabrics grey_interlock --motions lifting      # 15 minutes
python experiments/mesh_error.py                                                 # a day

Distances [mm] to the finest mesh of the elements named first, rms over the 25 places that all
meshes share: mean over the motion, and at its end. Motions that OUT's folder has are not simulated
again. `r2s.scenarios.resolution` chooses meshes by these figures.
"""

import itertools
from pathlib import Path

import equinox as eqx
import numpy as np
from _tables import Line, command_line, keep

from r2s import scenarios
from r2s.materials import presets
from r2s.mesh.mesh import ELEMENTS
from r2s.recordings.recording import corner
from r2s.scenarios.paths import Route, ease
from r2s.scenarios.scenario import rollout
from r2s.scenarios.standard import ALL_CORNERS, SIDE, Experiment, on_table

MAX_STEP = 1 / 90  # [s]
run = eqx.filter_jit(rollout)


def drape() -> Experiment:
    """A sheet held by its four corners, which come together by a quarter and stay."""
    sheet, times = on_table((SIDE, SIDE), ALL_CORNERS, 0.5), np.arange(31) / 15
    corners = np.array([corner(sheet, name) for name in ALL_CORNERS])
    nearer = corners + 0.25 * (corners.mean(axis=0) - corners)
    done = ease(times)[:, None, None]
    path = corners + done * (nearer - corners)
    return Experiment("drape", sheet, Route(times, path), times, (0, 30))


MOTIONS = {
    "lifting": lambda: scenarios.lifting(num_frames=46),
    "folding": lambda: scenarios.folding(num_frames=46),
    "wind": lambda: scenarios.wind(num_frames=31),
    "fling": lambda: scenarios.fling(num_frames=22),
    "drape": drape,
    "hang": lambda: scenarios.wind(speed=0.0, num_frames=3),
}


def places(folder: Path, motion: str, fabric: str, elements: str, count: int) -> np.ndarray:
    """The shared places [m] of a motion, (frame, 5, 5, 3); NaN from where it fails on.

    `count`: vertices a side. Simulated where the folder does not have it.
    """
    path = folder / f"{motion}-{fabric}-{elements}-{count}.npy"
    if not path.exists():
        scenario = MOTIONS[motion]().scenario((count, count), elements=elements)
        x = np.asarray(run(scenario, presets.FIVE[fabric](), MAX_STEP).x)
        every = (count - 1) // 4
        folder.mkdir(parents=True, exist_ok=True)
        np.save(path, x.reshape(len(x), count, count, 3)[:, ::every, ::every])
    return np.load(path)


def distance(motion: str, x: np.ndarray, finest: np.ndarray) -> np.ndarray:
    """Rms distance [mm] from the motion on the finest mesh, in every frame.

    A hanging sheet buckles to either side: it is mirrored where that is nearer.
    """
    both = [finest, finest * [1, -1, 1]] if motion == "hang" else [finest]
    rms = [np.sqrt(((x - y) ** 2).sum(axis=-1).mean(axis=(1, 2))) for y in both]
    return 1e3 * min(rms, key=np.mean)


if __name__ == "__main__":
    parser = command_line(__doc__, "results/mesh_error.csv")
    parser.add_argument("--motions", nargs="*", default=list(MOTIONS), choices=MOTIONS)
    parser.add_argument("--fabrics", nargs="*", default=list(presets.FIVE), choices=presets.FIVE)
    parser.add_argument("--elements", nargs="*", default=list(ELEMENTS), choices=ELEMENTS)
    parser.add_argument("--sizes", nargs="*", type=int, default=[9, 13, 17, 25, 33])
    a = parser.parse_args()
    folder, lines = a.out.with_suffix(""), []
    for motion, fabric in itertools.product(a.motions, a.fabrics):
        finest = places(folder, motion, fabric, a.elements[0], max(a.sizes))
        for elements in a.elements:
            line: Line = {"motion": motion, "fabric": fabric, "elements": elements}
            for count in a.sizes:
                x = places(folder, motion, fabric, elements, count)
                errors = distance(motion, x, finest)
                line[f"{count}"] = f"{errors.mean():.2f}"
                line[f"{count} at the end"] = f"{errors[-1]:.2f}"
            lines.append(line)
            keep(a.out, lines, "Distance [mm] from the finest mesh, mean and at the end.")
