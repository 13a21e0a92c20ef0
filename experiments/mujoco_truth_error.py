"""What mesh and step leave in the motions of MuJoCo's sheet, by which the study judges.

python experiments/mujoco_truth_error.py --out docs/results/mujoco_truth_error.csv   # ten minutes
python experiments/mujoco_truth_error.py --vertices 37                             # an hour

Differences [mm] to half the step, to a mesh of 3/2 as many cells a side, and to a fabric 0.1 %
stiffer, rms over the sheet and the frames and in the worst frame. A motion in which the last one
grows above the limit of 2 mm is chaotic: no mesh or step makes its end certain. Lines that a
table holds are not made again. Needs r2s[mujoco].
"""

from functools import partial

from _tables import Line, command_line, resumed

from r2s.study.drawn import experiment_of
from r2s.study.mujoco_error import ENOUGH, VARIANTS, Difference, differences
from r2s.study.mujoco_recording import SCENARIOS
from r2s.study.mujoco_sheet import STUDIED, Resolution

CAPTION = "Differences [mm] of MuJoCo's sheet, rms over sheet and frames / in the worst frame."


def shown(found: Difference) -> str:
    return f"{1e3 * found.rms:.2f} / {1e3 * found.worst:.2f}"


def measured(motion: str, number: str, resolution: Resolution) -> Line:
    """A line: the motion that is estimated from (lifting) or judged by, as the study draws it."""
    experiment = experiment_of(motion, int(number), motion != "lifting", 0)
    found = differences(experiment, resolution=resolution)
    error = max(found[name].rms for name in VARIANTS[:2])
    is_chaotic = found[VARIANTS[2]].worst > ENOUGH
    verdict = "converged" if error < ENOUGH else "chaotic" if is_chaotic else "not converged"
    return {name: shown(found[name]) for name in VARIANTS} | {"verdict": verdict}


if __name__ == "__main__":
    parser = command_line(__doc__, "results/mujoco_truth_error.csv")
    parser.add_argument("--motions", nargs="*", default=list(SCENARIOS), choices=SCENARIOS)
    parser.add_argument("--numbers", nargs="*", default=["0"], help="of each that is drawn")
    size = STUDIED.shape[0]
    parser.add_argument("--vertices", type=int, default=size, help=f"a side; the study's {size}")
    a = parser.parse_args()
    resolution = STUDIED._replace(shape=(a.vertices, a.vertices))
    jobs = [{"motion": motion, "number": number} for motion in a.motions for number in a.numbers]
    resumed(a.out, CAPTION, jobs, partial(measured, resolution=resolution))
