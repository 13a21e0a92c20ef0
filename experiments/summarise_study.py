"""Copy the tables of a study that the documents show, and put them into the documents.

python experiments/summarise_study.py results     # the folder that `make study` left
python experiments/summarise_study.py other --alone study_points --args "..."

The second: of a study of these ARGS the table of skill alone, for docs/study.md. Each table becomes
a file of OUT, which says what made it, and replaces what stands between the two marks of its name
in a document.
"""

import csv
import sys
import time
from pathlib import Path

from _study_tables import TABLES
from _tables import Line, command_line, insert, keep, shown


def table(results: Path, name: str) -> list[Line]:
    """Read a table of a study."""
    return list(csv.DictReader(open(results / "tables" / f"{name}.csv", encoding="utf-8")))


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results")
    parser.add_argument("results", type=Path)
    parser.add_argument("--alone", default="", help="name of a table of skill, without others")
    parser.add_argument("--args", default="", help="what `make study` had as ARGS")
    a = parser.parse_args()
    settings = {x["setting"]: x["value"] for x in table(a.results, "settings")}
    made_by = [name for name in settings if name.startswith("cells made by ")]
    if len(made_by) != 1:
        sys.exit(f"error: {a.results} is mixed, make it anew: {'; '.join(made_by) or 'of none'}")
    version = settings["version of r2s"]
    seconds = sum(float(x["CPU seconds in all"]) for x in table(a.results, "costs"))
    made = time.gmtime((a.results / "results.csv").stat().st_mtime)
    study = f'make study ARGS="{a.args}"' if a.args else "make study"
    more = f" --alone {a.alone} --args ..." if a.alone else ""
    facts = {
        "command": f"{study}; python experiments/summarise_study.py results{more}",
        "version": f"r2s {version}",
        "source": made_by[0].partition("source ")[2].partition(";")[0],
        "seed": settings["seed"],
        "date": time.strftime("%Y-%m-%d", made),
        "cost": f"{seconds / 60:.0f} CPU minutes",
    }
    tables = [("skill", "docs/study.md", a.alone, TABLES[1][3])] if a.alone else TABLES
    for source, document, name, caption, *columns in tables:
        whole, path = table(a.results, source), a.out / f"{name}.csv"
        keep(path, [{column: x[column] for column in columns or x} for x in whole], caption, facts)
        insert(Path(document), name, shown(path))
