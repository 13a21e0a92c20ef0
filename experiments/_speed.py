"""What `benchmarks/cloth.py` found, as tables."""

from typing import Any

from _tables import Line

LIMIT = 2.0  # [mm], over the first half second
RUNS = (
    "One second of the scene hang in CPU seconds of one core, median (least to most); error: rms "
    "distance from the same system with its smallest steps; slope: the gradient over differences."
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


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _ratio(value: float | None, over: float | None) -> str:
    return "-" if value is None or not over else f"{value / over:.3g}"


def _span(row: dict[str, Any], name: str) -> str:
    if name not in row:
        return "-"
    return f"{row[name]:.3g} ({row[name + '_min']:.3g} to {row[name + '_max']:.3g})"
