"""How fast is r2s beside its peers, in one run on one machine? Ratios are of CPU seconds.

taskset -c 0 python benchmarks/speed.py                                # all tables, an hour or more
taskset -c 0 python benchmarks/speed.py --only hang --sizes 9          # a part, one mesh

"hang": the cloth of r2s beside Newton and MuJoCo, at equal error. "points": material points beside
Taichi. Peers that are not installed are left out: pip install 'r2s[bench]'. Times are without
compilation. Measure on one core: JAX's threads hinder each other in steps as small as these, and
the peers use one. --out is the folder of the tables.
"""

import _measure
import _points
import _systems
import jax
from _measure import Line, command_line, keep

AT_EQUAL_ERROR = (
    "The cheapest run of each system within 2 mm over 0.5 s, and its time over that of r2s."
)
MATERIAL_POINTS = (
    "Material points, CPU seconds of one core without compilation: million particle-steps a "
    "second, and memory of the gradient."
)


def hang(options) -> None:
    """The cloths at equal error."""
    lines = _systems.at_equal_error(_systems.measured(options.sizes, options.repeats))
    keep(options.out / "hang_at_equal_error.csv", lines, AT_EQUAL_ERROR)


def points(options) -> None:
    """The block of material points in r2s and in Taichi."""
    loss, mu = _points.block_loss(options.steps)
    functions = loss, jax.value_and_grad(loss)
    systems = {"r2s": [_points.compiled(function, mu) for function in functions]}
    try:
        from peer_taichi import Block

        block = Block(options.steps)
        systems["taichi"] = [(block.run, block.memory), (block.run_back, block.memory)]
    except ModuleNotFoundError as error:
        print(f"skipped: taichi (pip install 'r2s[bench]': no {error.name})")
    lines: list[Line] = []
    for name, calls in systems.items():
        seconds = [_measure.timed(call, options.repeats)[0] for call, _ in calls]
        rates = [f"{_points.COUNT * options.steps / each / 1e6:.3g}" for each in seconds]
        line = {"system": name, "particles": str(_points.COUNT), "forward [M/s]": rates[0]}
        line |= {"value and gradient [M/s]": rates[1]}
        lines.append(line | {"memory of the gradient [MB]": f"{calls[1][1]:.0f}"})
    keep(options.out / "points.csv", lines, MATERIAL_POINTS)


PARTS = {"hang": hang, "points": points}

if __name__ == "__main__":
    parser = command_line(__doc__, "results/speed")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--sizes", nargs="+", type=int, default=[9, 17, 33], help="vertices a side")
    parser.add_argument("--steps", type=int, default=1024, help="of material points")
    parser.add_argument("--repeats", type=int, default=3)
    a = parser.parse_args()
    for part in a.only:
        PARTS[part](a)
