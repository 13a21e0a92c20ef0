"""Copy the tables of a study that the documents show, and put them into the documents.

python experiments/summarise_study.py results     # the folder that `make study` left

Each table becomes a file of OUT, which says what made it, and replaces what stands between the two
marks of its name in a document.
"""

import csv
import time
from pathlib import Path

from _tables import Line, command_line, insert, keep, shown

# the study's name, the document, the name there, a caption, and columns (none named: all)
TABLES = (
    (
        *("skill", "README.md", "study_small"),
        "Error up to the horizon, floor, and skill (1 at the floor, 0 of the default): mean "
        "[90 % interval over fabrics].",
        "configuration",
        *(f"{m}: {what}" for m in ("fling", "shaking") for what in ("error [mm]", "skill")),
    ),
    (
        *("skill", "docs/results.md", "study_small_skill"),
        "Error up to the horizon, floor and skill by configuration: mean [90 % interval].",
    ),
    (
        *("truths", "docs/results.md", "study_small_truths"),
        "Of every judged motion: horizon, and, mean up to there, its floor by cause.",
    ),
    (
        *("beyond_folding", "docs/results.md", "study_small_beyond_folding"),
        "Folding, from the horizon on: how much simulation and recording differ.",
    ),
    (
        *("chamfer_real_to_sim", "docs/results.md", "study_small_chamfer"),
        "Distance from the true surface to samples of the simulated one, whole motions.",
    ),
    (
        *("findings", "docs/results.md", "study_small_findings"),
        *("Conclusions of the paper, tested here.", "conclusion", "surface"),
    ),
    (
        *("parameters_cloth", "docs/results.md", "study_small_parameters"),
        *("Stiffness along warp and weft.", "recording", "warp", "weft"),
    ),
)


def table(results: Path, name: str) -> list[Line]:
    """Read a table of a study."""
    return list(csv.DictReader(open(results / "tables" / f"{name}.csv", encoding="utf-8")))


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results")
    parser.add_argument("results", type=Path)
    a = parser.parse_args()
    version = {x["setting"]: x["value"] for x in table(a.results, "settings")}["version of r2s"]
    seconds = sum(float(x["CPU seconds in all"]) for x in table(a.results, "costs"))
    made = time.gmtime((a.results / "results.csv").stat().st_mtime)
    facts = {
        "command": "make study; python experiments/summarise_study.py results",
        "version": f"r2s {version}",
        "date": time.strftime("%Y-%m-%d", made),
        "cost": f"{seconds / 60:.0f} CPU minutes",
    }
    for source, document, name, caption, *columns in TABLES:
        whole, path = table(a.results, source), a.out / f"{name}.csv"
        keep(path, [{column: x[column] for column in columns or x} for x in whole], caption, facts)
        insert(Path(document), name, shown(path))
