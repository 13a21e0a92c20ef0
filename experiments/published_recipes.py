"""What do the recipes of the approaches' papers predict, beside knowing nothing and the truth?

python experiments/published_recipes.py --out docs/results/published_recipes.csv    # two hours

Each as it is (`r2s.study.configuration.PUBLISHED_CONFIGURATIONS`), from one recording; PhysNet's
network is trained as in the preset "small"; of DIFFCLOUD's mass see `MultiplierSpace`. On the
cloth; references and skill are those of `experiments/skill_by_fabric.py`.
"""

from functools import partial
from pathlib import Path

from _skills import predicted_alone
from _tables import Line, command_line, resumed

from r2s.fabrics import presets

CONFIGURATIONS = (
    "diffcloud-published-cloth-lifting",
    "diffcp-published-points-lifting",
    "physnet-published-cloth-lifting",
    "pinn-published-cloth-stretching",
)
CAPTION = "By published recipes: mean distances [mm] up to the horizon on the cloth, and skill."


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/published_recipes.csv")
    fabrics = ["grey_interlock", "camel_ponte_roma"]
    parser.add_argument("--fabrics", nargs="+", choices=presets.FIVE, default=fabrics)
    parser.add_argument("--folder", type=Path, default=Path("results/published_recipes"))
    a = parser.parse_args()
    jobs: list[Line] = [
        {"fabric": fabric, "configuration": each} for fabric in a.fabrics for each in CONFIGURATIONS
    ]
    resumed(a.out, CAPTION, jobs, partial(predicted_alone, a.folder))
