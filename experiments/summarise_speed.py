"""Put what `benchmarks/cloth.py` found into docs/speed.md.

python experiments/summarise_speed.py results/speed.json    # that the benchmark wrote

The runs of the part "hang" become the table `hang`, and of each system the cheapest run within 2 mm
over half a second `hang_at_equal_error`: files of OUT, and between the marks of their names there.
"""

import json
from pathlib import Path

from _speed import EQUAL, RUNS, at_equal_error, runs
from _tables import command_line, insert, keep, shown

DOCUMENT = Path("docs/speed.md")

if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results")
    parser.add_argument("benchmark", type=Path, help="the file that the benchmark wrote")
    a = parser.parse_args()
    found = json.loads(a.benchmark.read_text(encoding="utf-8"))
    rows = [row for row in found["rows"] if row["part"] == "hang"]
    used = ("jax", "mujoco", "newton")
    libraries = ", ".join(f"{name} {found['machine'][name]}" for name in used)
    facts = {"libraries": libraries, "command": found["machine"]["command"]}
    tables = {"hang": (runs(rows), RUNS), "hang_at_equal_error": (at_equal_error(rows), EQUAL)}
    for name, (lines, caption) in tables.items():
        path = a.out / f"{name}.csv"
        keep(path, lines, caption, facts)
        insert(DOCUMENT, name, shown(path))
