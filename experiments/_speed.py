"""What `benchmarks/cloth.py` and `benchmarks/mpm.py` found, as tables."""

import math
from typing import Any

from _tables import Line

LIMIT = 2.0  # [mm], over the first half second
RUNS = (
    "One second of the scene hang in CPU seconds of one core, median (least to most); error: rms "
    "distance from the same system with its smallest steps; slope: the gradient over differences."
)
SCALING = (
    "The first 20 steps of 1/60 s of the scene hang, forward, median (least to most); exponent: of "
    "the number of vertices, from the size before."
)
MEMORY = (
    "Resident memory of value and gradient of a second of the scene hang, at the largest step: "
    "what the call added at its peak, and with what was built before it."
)
POINTS = (
    "Material points, CPU seconds of one core without compilation: million particle-steps a "
    "second, and memory of the gradient beside what all states would take."
)
SIDE_BY_SIDE = (
    "A lift of 60 frames, and its derivatives in seven parameters, as in an estimate: seconds of "
    "one of twelve, all threads of OpenBLAS or one."
)
EQUAL = "The cheapest run of each system within 2 mm over 0.5 s, and its time over that of r2s."


def runs(rows: list[dict[str, Any]]) -> list[Line]:
    """Every run: times, errors and its gradient over that by differences."""
    return [
        {
            "side": str(row["size"]),
            "system": row["system"],
            "steps": str(row["steps"]),
            "forward [s]": _span(row, "forward_cpu_s"),
            "value and gradient [s]": _span(row, "gradient_cpu_s"),
            "error over 0.5 s [mm]": _number(row.get("error_half_mm")),
            "error over 1 s [mm]": _number(row.get("error_mm")),
            "slope": _ratio(row.get("slope"), row.get("slope_by_differences")),
            "compiled in, forward / gradient [s]": f"{_number(row.get('forward_build_s'))} / "
            f"{_number(row.get('gradient_build_s'))}",
        }
        for row in rows
        if "limit_mm" not in row
    ]


def at_equal_error(rows: list[dict[str, Any]]) -> list[Line]:
    """The cheapest run of each system that is near enough."""
    return [
        {
            "side": str(row["size"]),
            "system": row["system"],
            "steps": str(row["steps"]),
            "forward [s]": _number(row["forward_s"]),
            "over r2s": _number(row["forward_ratio"]),
            "value and gradient [s]": _number(row["gradient_s"]),
            "over r2s's": _number(row["gradient_ratio"]),
        }
        for row in rows
        if row.get("limit_mm") == LIMIT and row["error"] == "error_half_mm"
    ]


def scaling(rows: list[dict[str, Any]]) -> list[Line]:
    """A forward step by the size of the mesh, and the exponent from one size to the next."""
    rows = [row for row in rows if "size" in row]
    lines = []
    for before, row in zip([None, *rows], rows, strict=False):
        power = "-"
        if before is not None:
            vertices = (row["size"] / before["size"]) ** 2
            power = f"{math.log(row['step_s'] / before['step_s']) / math.log(vertices):.2f}"
        line = {"side": str(row["size"]), "a step [ms]": f"{1e3 * row['step_s']:.3g}"}
        lines.append(line | {"run [s]": _span(row, "cpu_s"), "exponent": power})
    return lines


def memory(rows: list[dict[str, Any]]) -> list[Line]:
    """Memory of value and gradient at the largest step."""
    return [
        {
            "side": str(row["size"]),
            "system": row["system"],
            "call [MB]": f"{row['call_mb']:.0f}",
            "set up and call [MB]": f"{row['built_mb']:.0f}",
        }
        for row in rows
    ]


def points(rows: list[dict[str, Any]]) -> list[Line]:
    """Million particle-steps a CPU second of material points, and what a gradient takes."""
    return [
        {
            "scene": f"{row['part']}, {row['law']}",
            "system": row["system"],
            "particles": str(row["particles"]),
            "forward [M/s]": _number(row["forward_rate"]),
            "value and gradient [M/s]": _number(row["gradient_rate"]),
            "memory of the gradient [MB]": f"{row['gradient_memory_mb']:.0f}",
            "every state [MB]": f"{row['all_states_mb']:.0f}",
            "compiled in, forward / gradient [s]": f"{_number(row['forward_build_s'])} / "
            f"{_number(row['gradient_build_s'])}",
        }
        for row in rows
    ]


def side_by_side(rows: list[dict[str, Any]]) -> list[Line]:
    """What one of several motions takes one by one, and on threads."""
    return [
        {
            "vertices a side": str(row["side"]),
            "what": row["what"],
            "threads of OpenBLAS": row["threads"],
            "how": row["how"],
            "wall [s]": f"{row['wall_s']:.3f}",
            "CPU [s]": f"{row['cpu_s']:.3f}",
        }
        for row in rows
    ]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _ratio(value: float | None, over: float | None) -> str:
    return "-" if value is None or not over else f"{value / over:.3g}"


def _span(row: dict[str, Any], name: str) -> str:
    if name not in row:
        return "-"
    return f"{row[name]:.3g} ({row[name + '_min']:.3g} to {row[name + '_max']:.3g})"
