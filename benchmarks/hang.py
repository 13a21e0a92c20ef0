"""The scene "hang" in r2s and its peers: what each needs for which accuracy.

Each system at each size has a process of its own: what one has compiled is gone with it (XLA ran
out of room for code after some hundred programs).

The accuracy of a run is its rms distance from the same system's own motion with far smaller steps,
over all vertices and frames of 1/60 s, so that no system is judged by another's model. The sheet
buckles after half a second, and without damping two motions that differ by little part there.
"""

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import measure
import numpy as np
import scenes
import systems
from measure import Row
from systems import System

LIMITS = (("error_mm", 10.0), ("error_mm", 5.0), ("error_half_mm", 2.0))  # [mm]
PERIODS = {"error_mm": "1 s", "error_half_mm": "0.5 s"}
HALF = scenes.FRAMES // 2
DIFFERENCE = 0.02  # by which the stiffness is changed, to check a gradient [-]


def _reference(system: System, size: int, damping: float) -> np.ndarray:
    """Its motion with its smallest steps, in float64 where it can."""
    measure.progress(f"{system.name}, {size} a side: reference")
    with jax.enable_x64(True):
        return systems.call_of(system, "forward", size, system.finest, damping)[0]()


def _distance(x: np.ndarray, y: np.ndarray | None, frames: int = scenes.FRAMES) -> float | None:
    """Rms distance [mm] of two motions over their first frames; None when one is not finite."""
    if y is None:
        return None
    squared = np.sum((x[:frames].astype(float) - y[:frames]) ** 2, axis=-1)
    return 1e3 * float(np.sqrt(squared.mean())) if np.all(np.isfinite(squared)) else None


def _run(system: System, size: int, factor: int, options, finest: np.ndarray | None) -> Row:
    """One system at one size and step."""
    row: Row = {"system": system.name, "size": size}
    row["steps"] = scenes.FRAMES * systems.substeps(system, size, factor)
    row["damping_s"] = systems.damping_time(system, size, options.damping)
    measure.progress(f"{system.name}, {size} a side, {row['steps']} steps")
    clock = partial(measure.timed, repeats=options.repeats, budget=options.budget)
    build = partial(systems.call_of, system, size=size, factor=factor, damping=options.damping)
    call, row["forward_build_s"] = build("forward")
    times, x = clock(call)
    row |= measure.prefixed("forward", times)
    row["finite"] = bool(np.all(np.isfinite(x)))
    row["error_mm"], row["error_half_mm"] = _distance(x, finest), _distance(x, finest, HALF)
    if system.gradient and row["finite"]:
        backward, seconds = build("gradient")
        times, (_, slope) = clock(backward)
        row |= measure.prefixed("gradient", {"build_s": seconds, **times})
        row["slope"] = float(slope) if np.isfinite(slope) else None
        row["slope_by_differences"] = _slope(call, size)
    return row


def _slope(call: Callable[[float], np.ndarray], size: int) -> float | None:
    """The loss's derivative [m^2] in a factor on the stiffness, by central differences."""
    start = np.asarray(scenes.flat(scenes.sheet(size)), float)

    def loss(stiffness):
        return np.mean(np.sum((call(stiffness) - start) ** 2, axis=-1))

    slope = (loss(1 + DIFFERENCE) - loss(1 - DIFFERENCE)) / (2 * DIFFERENCE)
    return float(slope) if np.isfinite(slope) else None


def run(options, written: Callable[[list[Row]], None]) -> list[Row]:
    """All systems at all sizes; prints the plain table and those of equal accuracy.

    `written`: takes the rows so far, after each system.
    """
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        for size in options.sizes:
            for system in systems.available(options.systems):
                given = ["--system", system.name, str(size), folder, *_flags(options)]
                rows += measure.in_subprocess([str(Path(__file__).with_name("cloth.py")), *given])
                written([{"part": "hang", **row} for row in rows])
    _show(rows)
    return [{"part": "hang", **row} for row in rows + _equal_accuracy(rows)]


def _flags(options) -> list[str]:
    flags = ["--damping", str(options.damping), "--cores", str(options.cores)]
    flags += ["--repeats", str(options.repeats), "--budget", str(options.budget)]
    flags += ["--references", *map(str, options.references)]
    return flags + ["--double"] * options.double


def of_system(name: str, size: int, folder: Path, options) -> list[Row]:
    """The runs of one system at one size; its reference stays in a folder beside others."""
    (system,) = [system for system in systems.SYSTEMS if system.name == name]
    compared, finest, apart = size in options.references, None, None
    if compared:
        finest = _reference(system, size, options.damping)
        np.save(folder / f"{name} {size}.npy", finest)
        ours = folder / f"r2s {size}.npy"
        apart = _distance(finest, np.load(ours), HALF) if ours.exists() else None
    factors = system.factors if compared else system.factors[:1]
    runs = [_run(system, size, factor, options, finest) for factor in factors]
    return [run | {"from_r2s_mm": apart} for run in runs]


def _number(name: str, scale: float = 1.0) -> Callable[[Row], str]:
    return lambda row: "-" if row.get(name) is None else f"{scale * row[name]:.3g}"


def _show(rows: list[Row]) -> None:
    unit = measure.clock_name()

    def ratio(row):
        return f"{row[f'gradient_{unit}'] / row[f'forward_{unit}']:.1f}"

    columns = {
        "system": lambda row: row["system"],
        "side": _number("size"),
        "steps": lambda row: str(row["steps"]),
        "damping ms": _number("damping_s", 1e3),
        "forward s": lambda row: measure.span(row, f"forward_{unit}"),
        "value and gradient s": lambda row: measure.span(row, f"gradient_{unit}"),
        "ratio": lambda row: ratio(row) if "gradient_repeats" in row else "-",
        "error mm": _number("error_mm"),
        "to 0.5 s": _number("error_half_mm"),
        "slope": _number("slope"),
        "by differences": _number("slope_by_differences"),
        "from r2s mm": _number("from_r2s_mm"),
        "built s": _number("forward_build_s"),
        "gradient built s": _number("gradient_build_s"),
    }
    measure.show(f"hang, one second; {unit}: median (least..most)", rows, columns)
    print(
        "error: rms from the same system with its smallest steps; slope: the loss's derivative in "
        "a factor on the\nmembrane's stiffness, and that by differences over 4 %; from r2s: its "
        "reference from r2s's, to 0.5 s"
    )


def _equal_accuracy(rows: list[Row]) -> list[Row]:
    """For every size and accuracy, each system's cheapest run that reaches it; printed."""
    found = []
    for size in sorted({row["size"] for row in rows if row["error_mm"] is not None}):
        for error, limit in LIMITS:
            fit = [r for r in rows if r["size"] == size and _within(r, error, limit)]
            lines = [line | {"error": error, "limit_mm": limit} for line in _cheapest(fit)]
            title = f"hang, {size} a side: rms error over {PERIODS[error]} of at most {limit:g} mm"
            columns = {
                "system": lambda row: row["system"],
                "steps": lambda row: str(row["steps"]),
                "forward s": _number("forward_s"),
                "times r2s's": _number("forward_ratio"),
                "value and gradient s": _number("gradient_s"),
                "times r2s's ": _number("gradient_ratio"),
                "slope / differences": _number("slope_ratio"),
            }
            measure.show(title, lines, columns)
            found += lines
    return found


def _within(row: Row, error: str, limit: float) -> bool:
    return row[error] is not None and row[error] <= limit


def _cheapest(rows: list[Row]) -> list[Row]:
    """Of each system the run with the least time forward, and how many times r2s's that is."""
    unit = measure.clock_name()
    best: dict[str, Row] = {}
    for row in sorted(rows, key=lambda row: row[f"forward_{unit}"]):
        best.setdefault(row["system"], row)
    lines, ours = [], best.get("r2s", {})
    for row in best.values():
        line = {name: row[name] for name in ("system", "size", "steps")}
        for kind in ("forward", "gradient"):
            seconds, our_seconds = (r.get(f"{kind}_{unit}") for r in (row, ours))
            line[f"{kind}_s"] = seconds
            line[f"{kind}_ratio"] = seconds / our_seconds if seconds and our_seconds else None
        slope, expected = row.get("slope"), row.get("slope_by_differences")
        line["slope_ratio"] = slope / expected if slope and expected else None
        lines.append(line)
    return lines
