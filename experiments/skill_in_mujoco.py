"""How well does a sheet of MuJoCo move that was estimated from a lift of it, made by MuJoCo?

python experiments/skill_in_mujoco.py --out docs/results/skill_in_mujoco.csv    # an hour and a half

Neither laws nor contact, air or steps of these truths are ours (`r2s.study.mujoco_sheet`). Errors
are mean distances up to the horizon, beside the floor of an ensemble of MuJoCo's own, the middle of
the prior, the mean of draws of it (the default), and MuJoCo's own material in the laws of r2s (the
"true fabric"); skill is 1 at the floor and 0 at the default.
Needs r2s[mujoco].
"""

from functools import partial
from pathlib import Path

from _skills import predicted_elsewhere
from _tables import Line, command_line, resumed

CONFIGURATIONS = ("diffcloud-cloth-lifting", "diffcp-points-lifting", "physnet-cloth-lifting")
CAPTION = (
    "Of MuJoCo's sheet, from one of its lifts: mean distances [mm] up to the horizon, and skill. "
    "True fabric: its material in the laws of r2s."
)


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/skill_in_mujoco.csv")
    parser.add_argument("--configurations", nargs="+", default=CONFIGURATIONS)
    parser.add_argument("--repeats", type=int, default=8, help="estimates of the first, by lifts")
    parser.add_argument("--folder", type=Path, default=Path("results/skill_by_fabric"))
    a = parser.parse_args()
    jobs: list[Line] = [
        {"configuration": each, "repeat": f"{repeat}"}
        for each in a.configurations
        for repeat in range(a.repeats if each == CONFIGURATIONS[0] else 1)
    ]
    resumed(a.out, CAPTION, jobs, partial(predicted_elsewhere, a.folder))
