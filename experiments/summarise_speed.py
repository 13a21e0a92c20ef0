"""Put what `benchmarks/cloth.py`, `mpm.py` and `side_by_side.py` found into docs/speed.md.

python experiments/summarise_speed.py results/speed.json    # that a benchmark wrote

The runs of the part "hang" become the table `hang`, and of each system the cheapest run within 2 mm
over half a second `hang_at_equal_error`; those of "scaling" and "memory" the tables of these names;
those of material points `points`, those of threads `side_by_side`. Each is a file of OUT, and
stands between the marks of its name.
"""

import json
from pathlib import Path

import _speed
from _tables import command_line, insert, keep, shown

DOCUMENT = Path("docs/speed.md")
POINTS = ("2d", "3d", "sheet")  # parts of benchmarks/mpm.py
TABLES = {
    "hang": (("hang",), _speed.runs, _speed.RUNS),
    "hang_at_equal_error": (("hang",), _speed.at_equal_error, _speed.EQUAL),
    "scaling": (("scaling",), _speed.scaling, _speed.SCALING),
    "memory": (("memory",), _speed.memory, _speed.MEMORY),
    "points": (POINTS, _speed.points, _speed.POINTS),
    "side_by_side": (("side by side",), _speed.side_by_side, _speed.SIDE_BY_SIDE),
}

if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results")
    parser.add_argument("benchmark", type=Path, help="the file that the benchmark wrote")
    a = parser.parse_args()
    found = json.loads(a.benchmark.read_text(encoding="utf-8"))
    used = ("jax", "mujoco", "newton")
    libraries = ", ".join(f"{name} {found['machine'][name]}" for name in used)
    facts = {"libraries": libraries, "command": found["machine"]["command"]}
    facts["source"] = "not noted by the benchmark"
    for name, (parts, table, caption) in TABLES.items():
        rows = [row for row in found["rows"] if row["part"] in parts]
        if not rows:
            continue
        path = a.out / f"{name}.csv"
        keep(path, table(rows), caption, facts)
        insert(DOCUMENT, name, shown(path))
