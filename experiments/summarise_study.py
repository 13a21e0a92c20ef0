"""Reduce a study to what the documents show of it.

python experiments/summarise_study.py results     # the folder that `make study` left

Writes docs/results/study_small.csv and puts the same table between two marks of the README: mean
distance [mm] from the true surface to the simulation, and the 90 % interval of a bootstrap over
recordings. Two of the study's own tables go to docs/results.md in the same way.
"""

import csv
import time
from pathlib import Path

from _tables import Line, command_line, insert, keep, shown

from r2s.study.statistics.distances import means
from r2s.study.statistics.panel import by_motion, make_panel
from r2s.study.statistics.tables import read_rows

METRIC = "chamfer_real_to_sim"
CAPTION = "Distance from the true surface to the simulation [mm]: mean (90 % interval)."
COPIED = {  # tables of the study by name, and their columns that are shown
    "findings": ("Conclusions of the paper, tested here.", "conclusion", METRIC),
    "parameters_cloth": ("Stiffness along warp and weft.", "recording", "warp", "weft"),
}


def summary(results: Path) -> list[Line]:
    """One line for each configuration: its mean error [mm] on each motion, and the interval."""
    lines: dict[str, Line] = {}
    for motion, panel in by_motion(make_panel(read_rows(results), METRIC)).items():
        found = means(panel)
        for column, *numbers in zip(panel.columns, found.mean, found.low, found.high, strict=True):
            mean, low, high = (f"{1e3 * number:.1f}" for number in numbers)
            line = lines.setdefault(column.label, {"configuration": column.label})
            line[motion] = f"{mean} ({low} to {high})"
    return list(lines.values())


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/study_small.csv")
    parser.add_argument("results", type=Path)
    a = parser.parse_args()
    table = {
        name: list(csv.DictReader(open(a.results / "tables" / f"{name}.csv", encoding="utf-8")))
        for name in ("settings", "costs", *COPIED)
    }
    facts = {"command": f"make study; python experiments/summarise_study.py {a.results}"}
    version = {line["setting"]: line["value"] for line in table["settings"]}["version of r2s"]
    facts["version"] = f"r2s {version}"
    made = time.gmtime((a.results / "results.csv").stat().st_mtime)
    facts["date"] = time.strftime("%Y-%m-%d", made)
    seconds = sum(float(line["CPU seconds in all"]) for line in table["costs"])
    facts["cost"] = f"{seconds / 60:.0f} CPU minutes"
    keep(a.out, summary(a.results / "results.csv"), CAPTION, facts)
    insert(Path("README.md"), a.out.stem, shown(a.out))
    for name, (caption, *columns) in COPIED.items():
        path = a.out.with_name(f"{a.out.stem}_{name}.csv")
        keep(path, [{column: x[column] for column in columns} for x in table[name]], caption, facts)
        insert(Path("docs/results.md"), path.stem, shown(path))
