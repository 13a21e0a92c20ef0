"""How well is each of the five fabrics predicted by an estimate from some of its recordings?

python experiments/skill_by_fabric.py --out docs/results/skill_by_fabric.csv    # two hours
python experiments/skill_by_fabric.py --published --out docs/results/published_recipes.csv

By default from a lift and three pulls together. Errors are mean distances up to the horizon, beside
the floor of the truth, the true fabric at small strain, the prior mean and the mean of
samples of the prior; skill is 1 at the floor and 0 at the samples. Truths stiffen as they
stretch and lose up to 35 % of their bending stiffness, which estimates of constant stiffness
(`--law linear`) cannot follow; by default an estimate has the laws that its recordings determine.

With --published the recipes of the approaches' papers are compared (two hours, two fabrics), each
from one recording; PhysNet's network is trained as in the study's preset three_fabrics.
"""

import itertools
from functools import partial
from pathlib import Path

from _skills import predicted, predicted_alone
from _tables import Line, command_line, resumed

from r2s.materials import presets

TOGETHER = "diffcloud-cloth-lifting+stretching"
CAPTION = (
    "Mean distances [mm] up to the horizon, skill, and numbers of the estimate over the truth's "
    "at small strain (coupling: difference; *: the truth is outside its 90 % interval). Growth: by "
    "how much the energy of a 5 % stretch exceeds that of constant stiffness. Outliers: points or "
    "markers of each recording."
)
PUBLISHED = (
    "diffcloud-published-cloth-lifting",
    "diffcp-published-mpm-lifting",
    "physnet-published-cloth-lifting",
    "pinn-published-cloth-stretching",
)
BY_RECIPES = "By published recipes: mean distances [mm] up to the horizon on the cloth, and skill."


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/skill_by_fabric.csv")
    parser.add_argument("--fabrics", nargs="+", choices=presets.FIVE)
    parser.add_argument("--configurations", nargs="+", default=[TOGETHER])
    parser.add_argument("--published", action="store_true", help="the papers' recipes instead")
    parser.add_argument(
        "--law", default="identified", help="identified by the recordings, or linear, ..."
    )
    parser.add_argument("--folder", type=Path, default=Path("results/skill_by_fabric"))
    a = parser.parse_args()
    if a.published:
        pairs = itertools.product(a.fabrics or ("grey_interlock", "camel_ponte_roma"), PUBLISHED)
        jobs: list[Line] = [{"fabric": f, "configuration": c} for f, c in pairs]
        resumed(a.out, BY_RECIPES, jobs, partial(predicted_alone, a.folder))
    else:
        pairs = itertools.product(a.configurations, a.fabrics or presets.FIVE)
        jobs = [{"configuration": c, "law": a.law, "fabric": f} for c, f in pairs]
        resumed(a.out, CAPTION, jobs, partial(predicted, a.folder))
