"""How far is a coarse sheet from a fine one? By motion, fabric, elements and vertices a side.

python experiments/mesh_error.py --fabrics grey_interlock --motions lifting      # 15 minutes
python experiments/mesh_error.py                                                 # a day

Distances [mm] to the finest mesh of the elements named first, rms over the 25 places that all
meshes share. Variants switch parts: "stiff" bends 20 times as hard, "rough" does not slide on the
table. A sheet that hangs buckles to either side: it is mirrored where that is nearer. What is in
OUT's folder stays.
"""

import itertools

from _motions import MOTIONS, VARIANTS, distance, places
from _tables import Line, command_line, keep

from r2s.fabrics import presets
from r2s.geometry.mesh import ELEMENTS

if __name__ == "__main__":
    parser = command_line(__doc__, "results/mesh_error.csv")
    parser.add_argument("--motions", nargs="*", default=list(MOTIONS), choices=MOTIONS)
    parser.add_argument("--fabrics", nargs="*", default=list(presets.FIVE), choices=presets.FIVE)
    parser.add_argument("--elements", nargs="*", default=list(ELEMENTS), choices=ELEMENTS)
    parser.add_argument("--variants", nargs="*", default=["as it is"], choices=VARIANTS)
    parser.add_argument("--sizes", nargs="*", type=int, default=[9, 13, 17, 25, 33])
    a = parser.parse_args()
    lines: list[Line] = []
    for motion, fabric, name in itertools.product(a.motions, a.fabrics, a.variants):
        folder = a.out.with_suffix("")
        finest = places(folder, (motion, fabric, name, a.elements[0], max(a.sizes)))
        for elements in a.elements:
            line: Line = {"motion": motion, "fabric": fabric, "variant": name, "elements": elements}
            for count in a.sizes:
                x = places(folder, (motion, fabric, name, elements, count))
                found = distance(motion, x, finest)
                line |= {
                    f"{count}": f"{found.mean():.2f}",
                    f"{count} at the end": f"{found[-1]:.2f}",
                }
            lines.append(line)
            keep(a.out, lines, "Distance [mm] from the finest mesh, mean and at the end.")
