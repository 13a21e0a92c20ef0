"""Put what `benchmarks/sweeps.py` found on several devices into docs/speed.md.

python experiments/summarise_sweeps.py results/cpu.json results/gpu.json    # that it wrote

All runs become the table `sweeps`, in a file of OUT and between the marks of that name there.
"""

import json
from pathlib import Path
from typing import Any

from _tables import Line, command_line, insert, keep, shown

DOCUMENT = Path("docs/speed.md")
CAPTION = (
    "A quarter of a second of the scene hang (material points: a twentieth) of many fabrics in one "
    "vmap, on one core of a CPU and on a GPU, wall time without compilation. Seconds of motion are "
    "those of all fabrics together, in a second."
)


def line(device: str, row: dict[str, Any]) -> Line:
    """One run."""
    solver = row["solver"] + (
        f", {row['order']}" if row.get("order", "default") != "default" else ""
    )
    return {
        "device": device,
        "solver": solver,
        "side": str(row["side"]),
        "fabrics": str(row["members"]),
        "a step [us]": f"{row['step_us']:.3g}",
        "a fabric and step [us]": f"{row['fabric_step_us']:.3g}",
        "seconds of motion a second": f"{row['fabric_seconds_a_second']:.3g}",
        "least traffic [GB/s]": f"{row['least_traffic_gb_s']:.2g}",
        "finite": str(row["finite"]),
        "memory [MB]": f"{row['planned_mb']:.0f}",
    }


def _place(row: Line) -> tuple[str, int, str, int]:
    return row["solver"], int(row["side"]), row["device"], int(row["fabrics"])


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results")
    parser.add_argument("benchmarks", type=Path, nargs="+", help="files that the benchmark wrote")
    a = parser.parse_args()
    lines, libraries, commands = [], set(), {}
    for found in (json.loads(path.read_text(encoding="utf-8")) for path in a.benchmarks):
        device = found["machine"]["device"].replace("cpu", "CPU, one core")
        libraries.add(f"{device}, jax {found['machine']['jax']}")
        commands |= {found["machine"]["command"]: None}
        lines += [line(device, row) for row in found["rows"] if "step_us" in row]
    lines.sort(key=_place)
    facts = {"command": "; ".join(commands), "machine": "; ".join(sorted(libraries))}
    facts["source"] = "not noted by the benchmark"
    keep(a.out / "sweeps.csv", lines, CAPTION, facts)
    insert(DOCUMENT, "sweeps", shown(a.out / "sweeps.csv"))
