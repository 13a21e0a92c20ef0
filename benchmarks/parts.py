"""The parts of the benchmark: each takes the command's options, prints a table, gives rows."""

from functools import partial
from operator import itemgetter
from pathlib import Path

import equinox as eqx
import hang as hanging
import jax
import jax.numpy as jnp
import measure
import numpy as np
import ours
import scenes
import systems
from measure import Row

SCALING_FRAMES = 20  # of hang, a step each
LIFT_AIMS = "aims: 0.15 s, 100 MB"
SPREAD = 3.0  # of the stiffness and density in a batch, either way
SPREADS = 1.1, 3.0  # of all numbers of the fabrics that are compared with implicit ones
JUDGED = 4  # fabrics whose errors are known
IMPLICIT = 1, 2, 4, 8, 16  # implicit steps in 1/60 s
FINEST = 64  # of the reference


def hang(options) -> list[Row]:
    """r2s and its peers: forward and gradient at several steps, and at equal accuracy."""
    options.sizes = options.sizes or [9, 33, 65]
    return hanging.run(options, options.written)


def lift(options) -> list[Row]:
    """Value and gradient of DiffSim's 9 x 9 lift: time, and memory in a process of its own."""
    call, seconds = measure.built(lambda: ours.lift_gradient(9))
    row, (value, slope) = measure.timed(call, options.repeats, options.budget)
    finite = all(bool(jnp.isfinite(leaf)) for leaf in jax.tree.leaves((value, slope)))
    row |= {"part": "lift", "finite": finite, "build_s": seconds, **_probed("lift", 9, options)}
    columns = {
        "value and gradient s": lambda row: measure.span(row, measure.clock_name()),
        "finite": lambda row: str(row["finite"]),
        "built s": lambda row: f"{row['build_s']:.1f}",
        "call MB": lambda row: f"{row['call_mb']:.0f}",
        "process MB": lambda row: f"{row['process_mb']:.0f}",
    }
    measure.show(f"lift, 9 a side, 60 steps of 40 ms ({LIFT_AIMS})", [row], columns)
    return [row]


def compile(options) -> list[Row]:
    """Seconds from nothing to a compiled motion of 60 frames of one step, and its gradient."""
    rows = []
    for size in options.sizes or [9, 33]:
        for kind in ("forward", "gradient"):
            measure.progress(f"compile {kind}, {size} a side")
            jax.clear_caches()
            build = partial(getattr(ours, kind), size, 1, options.damping)
            row, _ = measure.timed(build, 1, 0.0)
            rows.append({"part": "compile", "size": size, "program": kind, **row})
    columns = {
        "side": lambda row: str(row["size"]),
        "program": lambda row: row["program"],
        "CPU s": lambda row: f"{row['cpu_s']:.1f}",
        "wall s": lambda row: f"{row['wall_s']:.1f}",
    }
    measure.show("tracing and compilation of 60 frames (aim for the gradient: 10 s)", rows, columns)
    return rows


def scaling(options) -> list[Row]:
    """Time of a forward step against the number of vertices, and the exponent of a power law."""
    rows = []
    for size in options.sizes or [17, 33, 65]:
        measure.progress(f"scaling, {size} a side")
        call = ours.forward(size, 1, options.damping, SCALING_FRAMES)
        row, x = measure.timed(call, options.repeats, options.budget)
        row |= {"part": "scaling", "size": size, "finite": bool(np.all(np.isfinite(x)))}
        row["step_s"] = row[measure.clock_name()] / SCALING_FRAMES
        rows.append(row)
    columns = {
        "side": lambda row: str(row["size"]),
        "vertices": lambda row: str(row["size"] ** 2),
        f"{SCALING_FRAMES} steps s": lambda row: measure.span(row, measure.clock_name()),
        "ms a step": lambda row: f"{1e3 * row['step_s']:.3g}",
        "finite": lambda row: str(row["finite"]),
    }
    measure.show(f"scaling: the first {SCALING_FRAMES} steps of 1/60 s of hang", rows, columns)
    if len(rows) > 1:
        vertices, seconds = ([row[k] for row in rows] for k in ("size", "step_s"))
        exponent = np.polyfit(2 * np.log(vertices), np.log(seconds), 1)[0]
        print(f"time of a step ~ vertices^{exponent:.2f} (aim: 1.2)")
        rows.append({"part": "scaling", "exponent": float(exponent)})
    return rows


def batch(options) -> list[Row]:
    """Many fabrics in one `vmap` against the same one by one: forward and gradient."""
    size = (options.sizes or [9])[0]
    setting = scenes.hang(size, 1)
    random = np.random.default_rng(0)

    def factor():
        return jnp.asarray(SPREAD ** random.uniform(-1, 1, options.members), float)

    members = jax.tree.map(lambda leaf: leaf * factor(), scenes.fabric(options.damping))
    singles = [jax.tree.map(itemgetter(i), members) for i in range(options.members)]
    functions = {
        "forward": scenes.motion,
        "gradient": eqx.filter_value_and_grad(scenes.motion_loss),
    }
    rows = [_batched(name, f, members, singles, setting, options) for name, f in functions.items()]
    columns = {
        "program": lambda row: row["program"],
        "together s": lambda row: measure.span(row, "together_wall_s"),
        "one by one s": lambda row: measure.span(row, "alone_wall_s"),
        "throughput": lambda row: f"{row['ratio']:.2f} x",
        "CPU seconds": lambda row: f"{row['cpu_ratio']:.2f} x",
        "finite": lambda row: f"{row['finite']} of {options.members}",
    }
    title = f"batch: hang of {options.members} fabrics, {size} a side, 60 steps; wall s (aim: 3 x)"
    measure.show(title, rows, columns)
    return rows


def _batched(name: str, function, members, singles, setting, options) -> Row:
    measure.progress(f"batch, {name}")
    together = eqx.filter_jit(eqx.filter_vmap(function, in_axes=(eqx.if_array(0), *[None] * 3)))
    together = together.lower(members, *setting).compile()
    alone = eqx.filter_jit(function).lower(singles[0], *setting).compile()

    def clock(call):
        return measure.timed(call, options.repeats, options.budget)

    row, result = clock(lambda: jax.block_until_ready(together(members, *setting)))
    apart, _ = clock(lambda: [jax.block_until_ready(alone(one, *setting)) for one in singles])
    leaves = [np.asarray(leaf).reshape(options.members, -1) for leaf in jax.tree.leaves(result)]
    finite = np.all([np.isfinite(leaf).all(axis=1) for leaf in leaves], axis=0)
    return {
        "part": "batch",
        "program": name,
        "finite": int(finite.sum()),
        "ratio": apart["wall_s"] / row["wall_s"],
        "cpu_ratio": apart["cpu_s"] / row["cpu_s"],
        **measure.prefixed("together", row),
        **measure.prefixed("alone", apart),
    }


def explicit(options) -> list[Row]:
    """A batch of fabrics in explicit steps, against implicit steps of the same error, one by one.

    Errors are distances of the first half second from implicit steps of 1/3840 s in float64, of the
    first `JUDGED` members.
    """
    rows = []
    for size in options.sizes or [9, 17]:
        for spread in SPREADS:
            random = np.random.default_rng(0)
            members = _varied(scenes.fabric(options.damping), spread, options.members, random)
            rows += _explicit(size, spread, members, options)
    columns = {
        "side": lambda row: str(row["size"]),
        "spread": lambda row: f"{row['spread']:g}",
        "steps": lambda row: row["steps"],
        "error mm": lambda row: f"{row['error_mm']:.3f}",
        "CPU s a fabric": lambda row: f"{row['cpu_s']:.4f}",
        "explicit is faster": lambda row: f"{row['ratio']:.1f} x",
        "built s": lambda row: f"{row['build_s']:.1f}",
    }
    title = f"explicit: hang of {options.members} fabrics together, implicit ones one by one"
    measure.show(f"{title} (aims: 10 x at 9, 8 x at 17, of the same error)", rows, columns)
    return rows


def _varied(fabric, spread: float, count: int, random):
    def factor():
        return jnp.asarray(spread ** random.uniform(-1, 1, count), float)

    return jax.tree.map(lambda leaf: leaf * factor(), fabric)


def _explicit(size: int, spread: float, members, options) -> list[Row]:
    """One explicit row, and those of implicit steps with their times over the explicit one."""
    singles = [jax.tree.map(itemgetter(i), members) for i in range(options.members)]
    measure.progress(f"explicit, {size} a side, spread {spread:g}: references")
    truths = _references(size, singles[:JUDGED])
    half = scenes.FRAMES // 2

    def error(found) -> float:
        pairs = zip(found, truths, strict=True)
        return float(np.mean([1e3 * np.sqrt(((x - y) ** 2).sum(-1).mean()) for x, y in pairs]))

    setting = scenes.explicit_hang(size, members)
    batched = eqx.filter_vmap(scenes.motion, in_axes=(eqx.if_array(0), None, None, None))
    run, seconds = measure.built(lambda: eqx.filter_jit(batched).lower(members, *setting).compile())
    call = partial(_finished, run, members, *setting)
    times, x = measure.timed(call, options.repeats, options.budget)
    common = {"part": "explicit", "size": size, "spread": spread}
    own = times["cpu_s"] / options.members
    solver = setting[0]
    rate = solver.substeps / solver.dt
    rows: list[Row] = [{**common, "steps": f"{rate:.0f} explicit", "build_s": seconds}]
    rows[0] |= {"error_mm": error(np.asarray(x)[:JUDGED, :half]), "cpu_s": own, "ratio": 1.0}
    for substeps in IMPLICIT:
        measure.progress(f"explicit, {size} a side: {60 * substeps} implicit steps")
        setting = scenes.hang(size, substeps)
        alone, seconds = measure.built(
            partial(eqx.filter_jit(scenes.motion).lower(singles[0], *setting).compile)
        )
        some = singles[: max(JUDGED, options.members // 8)]
        jax.block_until_ready(alone(singles[0], *setting))
        runs = (partial(_finished, alone, one, *setting) for one in some)
        each = [measure.timed(run, 1, 0.0) for run in runs]
        spent = float(np.mean([row["cpu_s"] for row, _ in each]))
        found = [np.asarray(x)[:half] for _, x in each[:JUDGED]]
        row = {**common, "steps": f"{60 * substeps} implicit", "build_s": seconds}
        rows.append(row | {"error_mm": error(found), "cpu_s": spent, "ratio": spent / own})
    return rows


def _finished(run, *arguments):
    return jax.block_until_ready(run(*arguments))


def _references(size: int, singles: list) -> list[np.ndarray]:
    """The first half second of some fabrics, in float64."""
    frames = scenes.FRAMES // 2
    with jax.enable_x64(True):
        setting = scenes.hang(size, FINEST, frames)
        precise = [jax.tree.map(lambda leaf: leaf.astype(float), one) for one in singles]
        run = eqx.filter_jit(scenes.motion).lower(precise[0], *setting).compile()
        return [np.asarray(run(one, *setting)) for one in precise]


def memory(options) -> list[Row]:
    """Peak memory of value and gradient of hang, each system in a process of its own."""
    rows = []
    for size in options.sizes or [9, 33]:
        for system in systems.available(options.systems):
            if system.gradient:
                found = _probed(system.name, size, options)
                rows.append({"part": "memory", "system": system.name, "size": size, **found})
    columns = {
        "system": lambda row: row["system"],
        "side": lambda row: str(row["size"]),
        "call MB": lambda row: f"{row['call_mb']:.0f}",
        "set up and call MB": lambda row: f"{row['built_mb']:.0f}",
        "process MB": lambda row: f"{row['process_mb']:.0f}",
    }
    measure.show("memory of value and gradient, at the largest step (resident)", rows, columns)
    return rows


def _probed(system: str, size: int, options) -> Row:
    """`probe` in a process of its own."""
    measure.progress(f"memory of {system}, {size} a side")
    script = str(Path(__file__).with_name("cloth.py"))
    flags = ["--damping", str(options.damping), "--cores", str(options.cores)]
    flags += ["--double"] * options.double
    return measure.in_subprocess([script, "--probe", system, str(size), *flags])


def probe(name: str, size: int, options) -> Row:
    """Peak memory [MB] of this process through one gradient of a system, or of the lift."""
    jax.config.update("jax_enable_x64", options.double)
    if name == "lift":
        return measure.peak_memory(lambda: ours.lift_gradient(size))
    (system,) = [system for system in systems.SYSTEMS if system.name == name]
    setting = system, "gradient", size, system.factors[0], options.damping
    return measure.peak_memory(lambda: systems.call_of(*setting)[0])
