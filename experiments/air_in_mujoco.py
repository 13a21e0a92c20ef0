"""How much of what MuJoCo's sheet does in a fling is its air's?

python experiments/air_in_mujoco.py --out docs/results/air_in_mujoco.csv    # minutes

After `skill_in_mujoco.py`, whose cells it needs. MuJoCo's own material in the laws of r2s, and the
estimate of it from its lift, predict its first fling and shaking in the air that r2s has
(`r2s.world.air`: a drag coefficient of 2 normal to the sheet, 0.02 along it) and in others. Errors
are mean distances up to the horizon, beside floor and default. Needs r2s[mujoco].
"""

from functools import partial
from pathlib import Path

from _air import moved_in_air
from _tables import Line, command_line, resumed

MATERIAL, LIFT = "its material", "estimate from lift"
AIRS = ((2.0, 0.02), (1.0, 0.02), (1.0, 1.0), (0.0, 0.0))  # across and along the sheet
CAPTION = (
    "Of MuJoCo's sheet: mean distances [mm] up to the horizon, and skill, by coefficients of the "
    "air across and along the sheet."
)


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/air_in_mujoco.csv")
    parser.add_argument("--folder", type=Path, default=Path("results/skill_by_fabric"))
    a = parser.parse_args()
    jobs: list[Line] = [
        {"fabric": fabric, "drag": f"{drag:g}", "skin friction": f"{skin:g}"}
        for fabric in (MATERIAL, LIFT)
        for drag, skin in AIRS
    ]
    resumed(a.out, CAPTION, jobs, partial(moved_in_air, a.folder))
