"""Does a study find the same by another kind of processor's instructions?

make study; cp -r results other; rm -r other/cells/networks other/cells/estimates
make study OUT=other ARGS="--no-cache" with XLA_FLAGS=--xla_cpu_max_isa=SSE4_2 in the environment
python experiments/other_processor.py results other --out docs/results/other_processor.csv

Errors up to the horizon, their intervals over fabrics and skill by configuration, of two studies
of the same recordings side by side, for all that both have estimated.
"""

import csv
from pathlib import Path

from _tables import Line, command_line, keep

MOTIONS = ("fling", "shaking")
CAPTION = (
    "Error [mm] and skill by configuration, mean [90 % interval over fabrics], of two studies. "
    "Recordings, floors and references are the first's in both."
)


def lines(folder: Path) -> dict[str, Line]:
    """The table of skill of a study, by configuration."""
    table = csv.DictReader(open(folder / "tables" / "skill.csv", encoding="utf-8"))
    return {line["configuration"]: line for line in table}


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/other_processor.csv")
    parser.add_argument("studies", type=Path, nargs=2, help="folders of results")
    parser.add_argument("--names", nargs=2, default=("AVX-512", "SSE4.2"), help="of the two")
    a = parser.parse_args()
    first, second = (lines(folder) for folder in a.studies)
    found: list[Line] = [
        {"configuration": name}
        | {
            f"{motion}: {what}, {whose}": line[f"{motion}: {what}"]
            for motion in MOTIONS
            for what in ("error [mm]", "skill")
            for whose, line in zip(a.names, (first[name], second[name]), strict=True)
        }
        for name in first
        if name in second and not name.startswith(("default", "middle", "true"))
    ]
    keep(a.out, found, CAPTION)
