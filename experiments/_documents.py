"""Put the tables of docs/results into the documents, between the marks of their names.

python experiments/_documents.py                      # all tables that a document shows
python experiments/_documents.py --study results      # first the skill of preset three_fabrics
python experiments/_documents.py --headline           # first the README's, from skill_by_fabric
"""

import argparse
import csv
import re
import sys
import time
from pathlib import Path

from _tables import Line, insert, read, shown, write

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"
MARK = re.compile(r"<!-- (?!end of )(\w+) -->")
STUDY = "make study PRESET=three_fabrics"
SKILL = (
    "Error up to the horizon, floor, and skill (1 at the floor, 0 of samples of the prior): mean "
    "[90 % interval over fabrics]."
)
COLUMNS = ["configuration"]
COLUMNS += [f"{m}: {what}" for m in ("fling", "shaking") for what in ("error [mm]", "skill")]


def study_table(results: Path, name: str) -> list[Line]:
    """A table of a study."""
    with open(results / "tables" / f"{name}.csv", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def copy_skill(results: Path) -> None:
    """Copy the table of skill of a study to docs/results, with what made it."""
    settings = {x["setting"]: x["value"] for x in study_table(results, "settings")}
    made_by = [name for name in settings if name.startswith("cells made by ")]
    if len(made_by) != 1:
        sys.exit(f"error: {results} is mixed, make it anew: {'; '.join(made_by) or 'of none'}")
    seconds = sum(float(x["CPU seconds in all"]) for x in study_table(results, "costs"))
    made = time.gmtime((results / "results.csv").stat().st_mtime)
    facts = {
        "command": f"{STUDY}; python experiments/_documents.py --study results",
        "version": f"r2s {settings['version of r2s']}",
        "source": made_by[0].partition("source ")[2].partition(";")[0],
        "seed": settings["seed"],
        "date": time.strftime("%Y-%m-%d", made),
        "cost": f"{seconds / 60:.0f} CPU minutes",
    }
    lines = [{column: x[column] for column in COLUMNS} for x in study_table(results, "skill")]
    write(RESULTS / "study_small.csv", lines, SKILL, facts)


HEADLINE = (
    "Mean distance [mm] of an unseen fling from its simulation, predicted from a lift and three "
    "pulls of the same fabric."
)
ROWS = {
    "estimate": "fling: estimate",
    "weight alone": "fling: prior mean",
    "true fabric": "fling: true fabric",
    "floor": "fling: floor",
}


def make_headline() -> None:
    """The estimates of both runs of skill_by_fabric, beside the prior mean, truth and floor."""
    first, facts = read(RESULTS / "skill_by_fabric.csv")
    again, _ = read(RESULTS / "skill_by_fabric_again.csv")
    columns = {line["fabric"]: line for line in first}
    second = {line["fabric"]: line["fling: estimate"] for line in again}
    lines = [
        {"": name} | {fabric.replace("_", " "): columns[fabric][key] for fabric in columns}
        for name, key in ROWS.items()
    ]
    repeated = {fabric.replace("_", " "): second.get(fabric, "-") for fabric in columns}
    lines.insert(1, {"": "estimate, again"} | repeated)
    made = {
        "table": HEADLINE,
        "command": "python experiments/_documents.py --headline",
        "version": facts["version"],
        "date": facts["date"],
    }
    write(RESULTS / "headline.csv", lines, HEADLINE, facts | made)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--study", type=Path, help="folder that `make study` left")
    parser.add_argument("--headline", action="store_true", help="the README's table")
    a = parser.parse_args()
    if a.study:
        copy_skill(a.study)
    if a.headline:
        make_headline()
    for document in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        for name in MARK.findall(document.read_text(encoding="utf-8")):
            insert(document, name, shown(RESULTS / f"{name}.csv"))
