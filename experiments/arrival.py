"""Do searches arrive? Estimates from thirty recordings of known sheets, beside the true numbers.

python experiments/arrival.py --out docs/results/arrival.csv     # three hours on one core
python experiments/arrival.py --cases "lift same denim" --seeds 1 2

Each line has, on the mesh of the estimate, the loss [mm^2], the mean distance [mm] of the recorded
points and the share of them beyond 3 mm, at the end of the estimate, at the true numbers and at the
prior mean; how far each number is from the truth, in standard errors (in brackets: the standard
error, a share of the value, of the coupling the number itself); and how many 90 % intervals hold.
Beside it, OUT_by_kind.csv has a line for each kind of recording. Recordings are made where the
folder does not have them. Needs r2s[mujoco].
"""

from functools import partial
from pathlib import Path

from _arrival import CASES, arrived
from _tables import Line, command_line, keep, resumed

CAPTION = (
    "Estimates from recordings of known sheets, beside the true numbers and the prior mean: loss "
    "[mm^2], mean distance of the points [mm], points beyond 3 mm; errors in standard errors."
)

BY_KIND = (
    "Searches by kind of recording: largest loss of the end over that of the true numbers, how "
    "many are at most 1.02, 90 % intervals that hold, estimates that say they are not sure."
)


def kind(case: str) -> str:
    """What a case has in common with others: its motion, and how its truth was made."""
    motion, made, *_ = case.split()
    return f"{motion}, {made if made in ('same', 'finer', 'stiffening', 'mujoco') else 'elements'}"


def by_kind(lines: list[Line]) -> list[Line]:
    """A line for each kind of recording, and one for all."""
    groups = {name: [x for x in lines if kind(x["case"]) == name] for name in map(kind, CASES)}
    return [_summary(name, group) for name, group in ({**groups, "all": lines}).items() if group]


def _summary(name: str, lines: list[Line]) -> Line:
    ratios = [float(x["loss of end"]) / float(x["loss of true"]) for x in lines]
    held, of = (sum(int(x["held"].split()[at]) for x in lines) for at in (0, 2))
    return {
        "recordings": name,
        "number": str(len(lines)),
        "largest ratio": f"{max(ratios):.3f}",
        "at most 1.02": str(sum(ratio <= 1.02 for ratio in ratios)),
        "hold": f"{held} of {of}",
        "not sure": str(sum(x["converged"] != "yes" for x in lines)),
    }


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/arrival.csv")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--seeds", nargs="+", default=["0"], help="of the places of the search")
    parser.add_argument("--folder", type=Path, default=Path("results/arrival"))
    a = parser.parse_args()
    jobs: list[Line] = [{"case": case, "seed": seed} for case in a.cases for seed in a.seeds]
    lines = resumed(a.out, CAPTION, jobs, partial(arrived, a.folder))
    keep(a.out.with_name(f"{a.out.stem}_by_kind.csv"), by_kind(lines), BY_KIND)
