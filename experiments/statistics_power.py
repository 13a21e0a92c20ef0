"""Do the study's statistics keep their promise? Made-up studies say, with effects and without.

python experiments/statistics_power.py --out docs/results/statistics_power.csv    # 25 minutes

Studies of the size of a preset are given to the functions that make the report. Without effects
(a ratio of 1) every finding is false; with them DIFFCLOUD from lifting is better than from wind,
and folding better than fling and shaking, by the ratio. A report leaves folds out where they tell
no fabrics apart; "without folds" are studies of such.
"""

from itertools import product
from pathlib import Path

import numpy as np
from _made_up import Spread, size_of
from _measured import Measured, measure
from _tables import Line, command_line, insert, keep, shown

from r2s.evaluation.statistics import LEVEL, SIGNIFICANCE

SPREADS = {
    "15 %": Spread(fabric=0.15, configuration=0.15),
    "30 %": Spread(fabric=0.3, configuration=0.3),
    "15 %, between motions as much": Spread(fabric=0.15, configuration=0.15, on_motion=0.15),
}
RATIOS = (1.0, 1.5, 3.0)
SIZES = {
    "small": size_of("small"),
    "paper": size_of("paper"),
    "paper, without folds": size_of("paper", ("fling", "shaking")),
}


def line(preset: str, words: str, ratio: float, found: Measured) -> Line:
    """The line of a table."""
    columns = (
        *("false in a study", "false alone", "the worst", "told", "told alone"),
        *("ratios held", "means held", "skills held"),
    )
    shares = [f"{100 * share:.1f} %" if np.isfinite(share) else "-" for share in found]
    told = dict(zip(columns, shares, strict=True))
    return {"preset": preset, "spread between fabrics": words, "ratio": f"{ratio:g}"} | told


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/statistics_power.csv")
    parser.add_argument("--studies", type=int, default=500)
    parser.add_argument(
        "--document", type=Path, help="into which to put the table, between its marks"
    )
    a = parser.parse_args()
    lines = [
        line(preset, words, ratio, measure(SIZES[preset], SPREADS[words], ratio, a.studies))
        for preset, words, ratio in product(SIZES, SPREADS, RATIOS)
    ]
    about = f"{a.studies} made-up studies a line: false findings at a nominal {SIGNIFICANCE:.0%}"
    caption = f"{about}, power, and how many intervals of {LEVEL:.0%} hold the truth."
    keep(a.out, lines, caption)
    if a.document:
        insert(a.document, a.out.stem, shown(a.out))
