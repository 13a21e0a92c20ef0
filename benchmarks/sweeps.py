"""How fast are sweeps over fabrics on this device, and what bounds them?

python benchmarks/sweeps.py                                      # on a GPU: 1 to 4,096 fabrics
python benchmarks/sweeps.py --members 1 16 --only implicit       # a short look
JAX_PLATFORMS=cpu taskset -c 0 python benchmarks/sweeps.py --members 1 16 64     # one core

The scene "hang" (see scenes.py), its first frames, of fabrics spread by half either way in each of
their numbers, together in one `jax.vmap`, float32. Wall seconds, without compilation. A step that
takes as long for one fabric as for many is bounded by the launch of its kernels; the slope between
the two largest batches is what a fabric costs once the device is full. `least traffic`: a state
read and written in each step, over the time: what memory has to move even if all else stays in
registers. Lines are written as they come; with --out also to a JSON file.
"""

import argparse
import dataclasses
import shlex
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import measure
import numpy as np
import scenes
from measure import Row

import r2s
from r2s import files
from r2s.cloth.linear.elimination import ORDERS, Elimination
from r2s.memory import planned
from r2s.mpm import Grid, Sheet
from r2s.mpm.sheet import stable_step

MOST = 4096  # fabrics, the stiffest of which all batches have the substeps of
SPREAD = 1.5  # of all numbers of the fabrics, either way
DAMPING = 0.01  # [s]
IMPLICIT = 4  # steps in a frame of 1/60 s: within 2 mm over half a second
SAFETY = 0.9  # of the longest stable step of material points
SIDES = {"implicit": (9, 17), "gradient": (9, 17), "explicit": (9, 17, 33), "points": (17,)}
FRAMES = {"implicit": 15, "gradient": 15, "explicit": 15, "points": 3}  # of 1/60 s


def fabrics(count: int) -> r2s.Fabric:
    """A batch of fabrics; the first are the same however many there are."""
    random = np.random.default_rng(0)

    def factors():
        return jnp.asarray(SPREAD ** random.uniform(-1, 1, MOST)[:count], float)

    return jax.tree.map(lambda leaf: leaf * factors(), scenes.fabric(DAMPING))


def stiffest(batch: r2s.Fabric) -> r2s.Fabric:
    """The fabric whose steps must be shorter than those of all of a batch."""
    found = jax.tree.map(jnp.max, batch)
    return eqx.tree_at(lambda f: f.density, found, jnp.min(batch.density))


def setting(kind: str, side: int, hardest: r2s.Fabric, order: Any = None) -> tuple[tuple, int]:
    """Solver, start and controls, and how many steps they are; `order`: of the elimination."""
    frames = FRAMES[kind]
    if kind in ("implicit", "gradient"):
        solver, start, controls = scenes.hang(side, IMPLICIT, frames)
        elimination = Elimination.make(solver.scene.mesh, order=order)
        solver = dataclasses.replace(solver, elimination=elimination)
        return (solver, start, controls), IMPLICIT * frames
    if kind == "explicit":
        found = scenes.explicit_hang(side, hardest, frames)
        return found, found[0].substeps * scenes.EXPLICIT_STEPS * frames
    return _points(side, hardest, frames)


def _points(side: int, hardest: r2s.Fabric, frames: int) -> tuple[tuple, int]:
    cloth, start, _ = scenes.hang(side, 1, 1)
    spacing = scenes.SIDE / (side - 1)
    grid = Grid.covering((-0.2, -0.2, -0.4), (1.2, 1.2, 0.3), spacing)
    longest = float(stable_step(cloth.scene.mesh, spacing, hardest, None))
    steps = int(np.ceil(1 / (60 * SAFETY * longest)))
    solver = Sheet.make(cloth.scene, grid, hardest, 1 / (60 * steps))
    handles = jnp.broadcast_to(start.x[cloth.scene.held], (frames, steps, 2, 3))
    controls = r2s.Control(handles, jnp.zeros((frames, steps, 3)))
    return (solver, solver.init(start.x), controls), steps * frames


def program(kind: str) -> Callable:
    """What is asked of each fabric: its motion, or a loss and its gradient."""
    function = (
        eqx.filter_value_and_grad(scenes.motion_loss) if kind == "gradient" else scenes.motion
    )
    return eqx.filter_vmap(function, in_axes=(eqx.if_array(0), None, None, None))


def measured(kind: str, side: int, members: int, options: argparse.Namespace) -> Row:
    """One row: how long a batch takes, how much memory, and whether its numbers are finite."""
    batch = fabrics(members)
    hardest = stiffest(fabrics(MOST))
    arguments, steps = setting(kind, side, hardest, options.order)
    build = eqx.filter_jit(program(kind)).lower(batch, *arguments).compile
    run, seconds = measure.built(build)
    common: Row = {"order": options.order or "default"} if kind in ("implicit", "gradient") else {}
    common |= {"solver": kind, "side": side, "members": members, "steps": steps, "build_s": seconds}
    common["planned_mb"] = planned(run.compiled) / 1e6
    if options.build_only:
        return common
    call = partial(_finished, run, batch, *arguments)
    call()
    times, found = measure.timed(call, options.repeats, options.budget)
    leaves = [np.asarray(leaf).reshape(members, -1) for leaf in jax.tree.leaves(found)]
    finite = np.all([np.isfinite(leaf).all(axis=1) for leaf in leaves], axis=0)
    moved = FRAMES[kind] / 60 * members
    state = sum(leaf.nbytes for leaf in jax.tree.leaves(arguments[1]) if eqx.is_array(leaf))
    return {
        **common,
        "step_us": 1e6 * times["wall_s"] / steps,
        "fabric_step_us": 1e6 * times["wall_s"] / steps / members,
        "fabric_seconds_a_second": moved / times["wall_s"],
        "least_traffic_gb_s": 2e-9 * state * steps * members / times["wall_s"],
        "finite": int(finite.sum()),
        **times,
    }


def _finished(run, *arguments):
    return jax.block_until_ready(run(*arguments))


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """All rows; what cannot run (memory) is a row that says so."""
    for kind in options.only:
        for side in options.sizes or SIDES[kind]:
            for members in sorted(options.members):
                measure.progress(f"{kind}, {side} a side, {members} fabrics")
                try:
                    yield measured(kind, side, members, options)
                except jax.errors.JaxRuntimeError as error:
                    text = str(error).splitlines()[0][:200]
                    named = {"solver": kind, "side": side, "members": members}
                    yield named | {"order": options.order or "default", "failed": text}


def main(options: argparse.Namespace) -> None:
    about = measure.machine() | {"command": shlex.join(["python", *sys.argv])}
    print(", ".join(f"{name}: {value}" for name, value in about.items()))
    found = []
    for row in rows(options):
        found.append(row)
        print(_line(row), flush=True)
        if options.out:
            files.write_json(options.out, {"machine": about, "rows": found})


def _line(row: Row) -> str:
    who = f"{row['solver']:9} {row['side']:3} {row['members']:5}"
    if "failed" in row:
        return f"{who}  failed: {row['failed']}"
    built = f"{row['planned_mb']:.0f} MB, built in {row['build_s']:.1f} s"
    if "wall_s" not in row:
        return f"{who}  {built}"
    return (
        f"{who}  {measure.span(row, 'wall_s')} s, {row['step_us']:.0f} us a step, "
        f"{row['fabric_step_us']:.3g} us a fabric and step, "
        f"{row['fabric_seconds_a_second']:.3g} s of motion a s, "
        f"{row['least_traffic_gb_s']:.2g} GB/s, "
        f"{row['finite']} finite, {built}"
    )


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Time sweeps over fabrics on this device.")
    parser.add_argument("--only", nargs="+", choices=list(SIDES), default=list(SIDES))
    parser.add_argument("--sizes", nargs="+", type=int, help="vertices a side")
    parser.add_argument("--order", choices=ORDERS, help="of implicit steps' elimination")
    parser.add_argument("--members", nargs="+", type=int, default=[1, 64, 1024, 4096])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--budget", type=float, default=10.0, help="repeat no longer than this [s]")
    parser.add_argument("--build-only", action="store_true", help="compile, to fill JAX's cache")
    parser.add_argument("--out", type=Path, help="JSON file")
    options = parser.parse_args()
    if not 1 <= min(options.members) <= max(options.members) <= MOST:
        parser.error(f"--members must be from 1 to {MOST}")
    return options


if __name__ == "__main__":
    main(_arguments())
