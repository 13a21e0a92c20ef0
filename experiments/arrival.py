"""Do searches arrive? Estimates from thirty recordings of known sheets, beside the true numbers.

python experiments/arrival.py --out docs/results/arrival.csv     # three hours on one core
python experiments/arrival.py --cases "lift same denim" --seeds 1 2

Each line has, on the mesh of the estimate, the loss [mm^2], the mean distance [mm] of the recorded
points and the share of them beyond 3 mm, at the end of the estimate, at the true numbers and at the
prior mean; how far each number is from the truth, in standard errors (in brackets: the standard
error, a share of the value, of the coupling the number itself); and how many 90 % intervals hold.
Recordings are made where the folder does not have them. Needs r2s[mujoco].
"""

from functools import partial
from pathlib import Path

from _arrival import CASES, arrived
from _tables import Line, command_line, resumed

CAPTION = (
    "Estimates from recordings of known sheets, beside the true numbers and the prior mean: loss "
    "[mm^2], mean distance of the points [mm], points beyond 3 mm; errors in standard errors."
)


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/arrival.csv")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--seeds", nargs="+", default=["0"], help="of the places of the search")
    parser.add_argument("--folder", type=Path, default=Path("results/arrival"))
    a = parser.parse_args()
    jobs: list[Line] = [{"case": case, "seed": seed} for case in a.cases for seed in a.seeds]
    resumed(a.out, CAPTION, jobs, partial(arrived, a.folder))
