"""Estimates from what MuJoCo simulates, and how well they predict what else MuJoCo simulates.

python experiments/another_simulator.py --out docs/results/skill_in_mujoco.csv     # 90 minutes

The laws, contact, air and steps of MuJoCo's sheet are not those of r2s (`r2s.study.mujoco`).
From lifts of it, its fold, fling and shaking are predicted. Errors are mean distances up to the
horizon, beside the floor of an ensemble of MuJoCo's own, the prior mean, the mean of
samples of the prior, and MuJoCo's material in the laws of r2s (the "true fabric"); skill is
1 at the floor and 0 at the samples. Needs r2s[mujoco].
"""

from functools import partial
from pathlib import Path

from _skills import predicted_alone
from _tables import Line, command_line, resumed

from r2s.study.configuration import MOTIONS
from r2s.study.mujoco import FABRIC

CONFIGURATIONS = ("diffcloud-cloth-lifting", "diffcp-mpm-lifting", "physnet-cloth-lifting")
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
        {"configuration": name, "repeat": f"{repeat}"}
        for name in a.configurations
        for repeat in range(a.repeats if name == CONFIGURATIONS[0] else 1)
    ]
    make = partial(predicted_alone, a.folder, fabric=FABRIC, motions=MOTIONS)
    resumed(a.out, CAPTION, jobs, make)
