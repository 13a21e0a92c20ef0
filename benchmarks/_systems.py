"""The cloths that are compared in the scene "hang": what each needs for which accuracy.

The accuracy of a run is its rms distance from the same system's motion with far smaller steps, over
all vertices and the frames of the first half second, so that no system is judged by the model of
another. (After that the sheet buckles, and two motions that differ by little separate.)
"""

import importlib
import math
import sys
from types import ModuleType
from typing import Any, NamedTuple

import _hang
import _measure
import jax
import numpy as np

DAMPING = 0.01  # [s], where a system does not have its own
EVERY_FRAME = 0.0  # rate of implicit systems: their steps do not depend on the mesh
LIMIT = 2.0  # [mm], of the error
HALF = _hang.FRAMES // 2
COLUMNS = (
    ("forward_s", "forward [s]", "over r2s"),
    ("gradient_s", "value and gradient [s]", "over r2s's"),
)
LIGHT = 6e-4  # [s], on one cell: a tenth of the longest explicit step; more would shorten the steps


class System(NamedTuple):
    """A cloth, and the settings of its runs.

    - `module`: has the functions `forward` and, if not None, `gradient`, as `_hang`.
    - `damping`: time [s], times the cells a side; None: `DAMPING`.
    - `rate`: steps in a second, by the cells a side; `EVERY_FRAME`: one step a frame of 1/60 s.
    - `factors`: by which that is multiplied, the fewest steps first. `finest`: of the reference.
    """

    module: str
    forward: str
    gradient: str | None
    damping: float | None
    rate: float
    factors: tuple[int, ...]
    finest: int


ALPHA, TRIANGLES = ((f"forward_{how}", f"gradient_{how}") for how in ("alpha", "triangles"))
SYSTEMS = {
    "r2s": System("_hang", "forward", "gradient", None, EVERY_FRAME, (1, 2, 4, 8), 32),
    "r2s, generalised alpha": System("_hang", *ALPHA, None, EVERY_FRAME, (1, 2, 4), 32),
    "r2s, triangles": System("_hang", *TRIANGLES, None, EVERY_FRAME, (2, 4), 32),
    "r2s explicit": System("_hang", "forward_explicit", None, None, EVERY_FRAME, (1,), 4),
    "Newton explicit": System("peer_newton", "forward", "gradient", 0.0, 180, (1, 2), 16),
    "Newton explicit, damped": System("peer_newton", "forward", "gradient", LIGHT, 180, (2,), 16),
    "MuJoCo": System("peer_mujoco", "forward_implicit", None, None, EVERY_FRAME, (16, 64), 256),
    "MuJoCo explicit": System("peer_mujoco", "forward_explicit", None, 0.0, 180, (1, 2), 16),
}


def measured(sizes: list[int], repeats: int) -> list[dict[str, Any]]:
    """The runs of all systems that are installed: times [s], steps and errors [mm]."""
    rows = []
    for size in sizes:
        for name, system in SYSTEMS.items():
            print(f"{name}, {size} a side", file=sys.stderr, flush=True)
            try:
                module = importlib.import_module(system.module)
            except ModuleNotFoundError as error:
                print(f"skipped: {name} (pip install 'r2s[bench]': no {error.name})")
                continue
            rows += [
                {"system": name, "size": size} | run for run in _runs(system, module, size, repeats)
            ]
            jax.clear_caches()  # XLA runs out of room for code otherwise
    return rows


def _runs(system: System, module: ModuleType, size: int, repeats: int) -> list[dict[str, Any]]:
    """The runs of one system on one mesh."""
    damping = DAMPING if system.damping is None else system.damping / (size - 1)
    forward = getattr(module, system.forward)
    with jax.enable_x64(True):
        finest = forward(size, _substeps(system, size, system.finest), damping)()
    rows = []
    for factor in system.factors:
        substeps = _substeps(system, size, factor)
        seconds, x = _measure.timed(forward(size, substeps, damping), repeats)
        squared = np.sum((x[:HALF].astype(float) - finest[:HALF]) ** 2, axis=-1)
        row = {"steps": _hang.FRAMES * substeps, "forward_s": seconds}
        row["error_mm"] = 1e3 * float(np.sqrt(squared.mean()))
        if system.gradient and np.isfinite(row["error_mm"]):
            backward = getattr(module, system.gradient)(size, substeps, damping)
            row["gradient_s"] = _measure.timed(backward, repeats)[0]
        rows.append(row)
    return rows


def _substeps(system: System, size: int, factor: int) -> int:
    """Steps in a frame of 1/60 s; even for explicit systems."""
    if system.rate == EVERY_FRAME:
        return factor
    return 2 * math.ceil(system.rate * (size - 1) * factor / 120)


def at_equal_error(rows: list[dict[str, Any]]) -> list[dict[str, str]]:
    """The table: each system's cheapest run within the limit, and its times over those of r2s."""
    lines = []
    for size in dict.fromkeys(row["size"] for row in rows):
        best: dict[str, dict[str, Any]] = {}
        near = [row for row in rows if row["size"] == size and row["error_mm"] <= LIMIT]
        for row in sorted(near, key=lambda row: row["forward_s"]):
            best.setdefault(row["system"], row)
        ours = best.get("r2s", {})
        for name, row in best.items():
            line = {"side": str(size), "system": name, "steps": str(row["steps"])}
            for kind, column, over in COLUMNS:
                line |= {column: "-", over: "-"}
                if kind in row:
                    line[column] = f"{row[kind]:.3g}"
                if kind in row and kind in ours:
                    line[over] = f"{row[kind] / ours[kind]:.3g}"
            lines.append(line)
    return lines
