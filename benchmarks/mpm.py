"""How fast is the material point method of r2s, beside Taichi's, in one run on one machine?

python benchmarks/mpm.py                              # everything; ten minutes
python benchmarks/mpm.py --only 2d --systems r2s      # a part
python benchmarks/mpm.py --steps 64                   # a short look

An elastic block of random particles falls in a box: the same scheme in both (MLS-MPM, quadratic
B-splines, APIC), float32. "2d": 8,192 particles, 128 x 128 nodes, 1,024 steps. "3d": 6,912
particles, 32^3 nodes. "sheet": a sheet of fabric lifted off a table by a corner, r2s only.

Peer: pip install taichi==1.7.4; skipped where it is missing. Times are process CPU seconds on one
core (wall seconds where JAX runs on a GPU), without compilation.
"""

import argparse
import importlib.util
import shlex
import sys
from functools import partial
from pathlib import Path

import jax
import measure
import mpm_ours
import mpm_scenes
from measure import Row

from r2s import files

PARTS = ("2d", "3d", "sheet")
LAWS = {"2d": ("corotated", "neo-hookean"), "3d": ("corotated", "neo-hookean"), "sheet": ("camel",)}


def main(options: argparse.Namespace) -> None:
    about = measure.machine() | {"command": shlex.join(["python", *sys.argv])}
    print(", ".join(f"{name}: {value}" for name, value in about.items()))
    rows = []
    for part in options.only:
        for law in LAWS[part]:
            for system in options.systems:
                if part == "sheet" and system != "r2s":
                    continue
                rows += _rows(system, part, law, options)
                if options.out:
                    files.write_json(options.out, {"machine": about, "rows": rows})
    _show(rows)


def _rows(system: str, part: str, law: str, options: argparse.Namespace) -> list[Row]:
    if system == "taichi" and importlib.util.find_spec("taichi") is None:
        print("skipped: taichi (not installed; pip install taichi==1.7.4)")
        return []
    if system == "taichi" and part == "3d" and not options.slow:
        print("skipped: taichi in 3-D, whose gradient compiles for minutes; --slow runs it")
        return []
    if system == "taichi" and part == "3d" and law == "corotated":
        print("skipped: taichi, corotated in 3-D: it does not differentiate that kernel")
        return []
    measure.progress(f"{system}, {part}, {law}")
    clock = partial(measure.timed, repeats=options.repeats, budget=options.budget)
    scene = mpm_scenes.SCENES[part](law, options.steps)
    row: Row = {"system": system, "part": part, "law": law, "steps": scene.steps}
    row["particles"] = scene.count
    if system == "r2s":
        build = mpm_ours
    else:
        import mpm_taichi as build
    for kind in ("forward", "gradient"):
        (call, memory), seconds = measure.built(lambda k=kind, b=build: getattr(b, k)(scene))
        times, value = clock(call)
        row |= measure.prefixed(kind, {"build_s": seconds, "memory_mb": memory, **times})
        rate = scene.count * scene.steps / times[measure.clock_name()] / 1e6
        row[f"{kind}_rate"], row[f"{kind}_value"] = rate, value
    row["all_states_mb"] = scene.state_bytes * scene.steps / 1e6
    return [row]


def _show(rows: list[Row]) -> None:
    def number(name):
        return lambda row: f"{row[name]:.3g}"

    columns = {
        "system": lambda row: row["system"],
        "scene": lambda row: row["part"],
        "law": lambda row: row["law"],
        "steps": lambda row: str(row["steps"]),
        "forward M/s": number("forward_rate"),
        "value and gradient M/s": number("gradient_rate"),
        "built s": number("forward_build_s"),
        "gradient built s": number("gradient_build_s"),
        "gradient MB": number("gradient_memory_mb"),
        "all states MB": number("all_states_mb"),
        "value": lambda row: f"{row['forward_value']:.6g}",
        "slope": lambda row: f"{row['gradient_value']:.6g}",
    }
    title = f"million particle-steps a second, by {measure.clock_name()}"
    measure.show(title, rows, columns)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Time the material point method of r2s.")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="parts to run")
    parser.add_argument(
        "--systems", nargs="+", choices=("r2s", "taichi"), default=("r2s", "taichi")
    )
    parser.add_argument("--steps", type=int, default=1024)
    parser.add_argument("--slow", action="store_true", help="also what compiles for minutes")
    parser.add_argument("--cores", type=int, default=1, help="to run on; 0: all")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--budget", type=float, default=20.0, help="repeat no longer than this [s]")
    parser.add_argument("--out", type=Path, help="JSON file")
    options = parser.parse_args()
    if options.steps < 32 or options.steps % 32 or options.repeats < 1:
        parser.error("--steps must be a multiple of 32 and --repeats at least 1")
    return options


if __name__ == "__main__":
    arguments = _arguments()
    measure.keep_to(arguments.cores)
    jax.config.update("jax_enable_x64", False)
    main(arguments)
