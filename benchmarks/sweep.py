"""How many fabrics move at once? Sweeps on this device.

python benchmarks/sweep.py                                      # on a GPU: 1 to 4,096 fabrics
python benchmarks/sweep.py --members 1 16 --only implicit       # a short look
JAX_PLATFORMS=cpu taskset -c 0 python benchmarks/sweep.py --members 1 64     # one core

The first frames of the scene "hang" (see `_hang.py`), of fabrics whose numbers are spread by a
factor of 1.5 either way, together in one `jax.vmap`, float32: implicit steps and their gradient,
explicit steps, material points. A step that takes as long for one fabric as for many is bounded by
the launch of its kernels.
"""

import _hang
import _measure
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _measure import Line, command_line, keep

import r2s
from r2s.solvers.mpm import Grid, MPMCloth
from r2s.solvers.mpm.sheet import stable_step

MOST = 4096  # fabrics, the stiffest of which all batches have the substeps of
SPREAD = 1.5
IMPLICIT_STEPS = 4  # in a frame of 1/60 s: within 2 mm over half a second
SAFETY = 0.9  # of the longest stable step of material points
SIDES = {"implicit": (9, 17), "gradient": (9, 17), "explicit": (9, 17, 33), "mpm": (17,)}
FRAMES = {"implicit": 15, "gradient": 15, "explicit": 15, "mpm": 3}  # of 1/60 s
CAPTION = (
    "A quarter of a second of the scene hang (material points: a twentieth) of many fabrics in one "
    "vmap, on one core of a CPU and on a GPU, wall time without compilation. Seconds of motion are "
    "those of all fabrics together, in a second."
)


def fabrics(count: int) -> r2s.Fabric:
    """A batch of fabrics; the first are the same however many there are."""
    random = np.random.default_rng(0)

    def factors():
        return jnp.asarray(SPREAD ** random.uniform(-1, 1, MOST)[:count], float)

    return jax.tree.map(lambda leaf: leaf * factors(), _hang.fabric(damping=0.01))


def setting(kind: str, side: int) -> tuple[tuple, int]:
    """Solver, start, control and steps a frame, and how many steps they are."""
    frames, batch = FRAMES[kind], fabrics(MOST)
    stiffest = jax.tree.map(jnp.max, batch)
    stiffest = eqx.tree_at(lambda f: f.density, stiffest, jnp.min(batch.density))
    if kind == "explicit":
        arguments = _hang.explicit_hang(side, stiffest, frames)
        return arguments, arguments[0].substeps * _hang.EXPLICIT_STEPS * frames
    solver, start, control, every = _hang.hang(side, IMPLICIT_STEPS, frames)
    if kind == "mpm":
        spacing = _hang.SIDE / (side - 1)
        longest = float(stable_step(solver.scene.mesh, spacing, stiffest, None))
        steps = int(np.ceil(1 / (60 * SAFETY * longest)))
        grid = Grid.covering((-0.2, -0.2, -0.4), (1.2, 1.2, 0.3), spacing)
        points = MPMCloth(solver.scene, 1 / (60 * steps), stiffest, grid)
        path = jnp.broadcast_to(start.x[solver.scene.pinned], (frames * steps, 2, 3))
        return (points, points.init(start.x), r2s.Control(path), steps), steps * frames
    return (solver, start, control, every), IMPLICIT_STEPS * frames


def line(kind: str, side: int, members: int, repeats: int) -> Line:
    """The line of a table: how long a batch takes, how much memory, and how many are finite."""
    head = {"device": jax.devices()[0].device_kind, "solver": kind}
    head |= {"side": str(side), "fabrics": str(members)}
    batch, (arguments, steps) = fabrics(members), setting(kind, side)
    function = _hang.motion
    if kind == "gradient":
        function = eqx.filter_value_and_grad(_hang.motion_loss)
    batched = eqx.filter_vmap(function, in_axes=(eqx.if_array(0), None, None, None, None))
    run = eqx.filter_jit(batched).lower(batch, *arguments).compile()
    seconds, results = _measure.timed(
        lambda: jax.block_until_ready(run(batch, *arguments)), repeats, wall=True
    )
    leaves = [np.asarray(leaf).reshape(members, -1) for leaf in jax.tree.leaves(results)]
    finite = np.all([np.isfinite(leaf).all(axis=1) for leaf in leaves], axis=0)
    step = seconds / steps
    return head | {
        "a step [us]": f"{1e6 * step:.3g}",
        "a fabric and step [us]": f"{1e6 * step / members:.3g}",
        "seconds of motion a second": f"{FRAMES[kind] / 60 * members / seconds:.3g}",
        "finite": str(finite.sum()),
        "memory [MB]": f"{_measure.memory(run.compiled):.0f}",
    }


if __name__ == "__main__":
    parser = command_line(__doc__, "results/sweeps.csv")
    parser.add_argument("--only", nargs="+", choices=list(SIDES), default=list(SIDES))
    parser.add_argument("--sizes", nargs="+", type=int, help="vertices a side")
    parser.add_argument("--members", nargs="+", type=int, default=[1, 64, 1024, MOST])
    parser.add_argument("--repeats", type=int, default=3)
    a = parser.parse_args()
    lines = []
    for kind in a.only:
        for side in a.sizes or SIDES[kind]:
            for members in a.members:
                lines.append(line(kind, side, min(members, MOST), a.repeats))
                keep(a.out, lines, CAPTION)
