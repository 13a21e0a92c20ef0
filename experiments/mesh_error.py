"""How far is a coarse sheet from a fine one? By motion, fabric, elements and vertices a side.

python experiments/mesh_error.py --fabrics grey_interlock --motions lifting      # 15 minutes
python experiments/mesh_error.py                                                 # a day

Distances [mm] to the finest mesh of the elements named first, rms over the 25 places that all
meshes share: mean over the motion, and at its end. Motions that OUT's folder has are not simulated
again. `r2s.scenarios.resolution` chooses meshes by these figures.
"""

import itertools

from _meshes import MOTIONS, distance, places
from _tables import Line, command_line, keep

from r2s.fabrics import presets
from r2s.geometry.mesh import ELEMENTS

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
                found = distance(motion, x, finest)
                line[f"{count}"] = f"{found.mean():.2f}"
                line[f"{count} at the end"] = f"{found[-1]:.2f}"
            lines.append(line)
            keep(a.out, lines, "Distance [mm] from the finest mesh, mean and at the end.")
