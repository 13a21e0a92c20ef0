"""What do the cloth's implicit steps leave in a motion, beside what its mesh does?

python experiments/step_error.py --out docs/results/step_error.csv    # ten minutes

The truth, a fabric whose stiffness changes with the strain, on 33 x 33 vertices in explicit steps;
the same fabric in implicit steps of the scenario's length and of shares of it, and on coarser
meshes. Distances are between the same places of the sheet, in the frames that an estimate compares.
"""

from _steps import apart_in_steps
from _tables import Line, command_line, resumed

from r2s.fabrics import presets

CAPTION = (
    "Distance [mm] of the same fabric in implicit steps of 33 x 33 vertices, and on coarser "
    "meshes, from 33 x 33 in explicit steps: mean over the frames that count."
)


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/step_error.csv")
    parser.add_argument("--fabrics", nargs="+", choices=presets.FIVE, default=list(presets.FIVE))
    parser.add_argument("--scenarios", nargs="+", default=["lifting"], help="of sheets that lie")
    a = parser.parse_args()
    jobs: list[Line] = [
        {"scenario": scenario, "fabric": fabric} for scenario in a.scenarios for fabric in a.fabrics
    ]
    resumed(a.out, CAPTION, jobs, apart_in_steps)
