"""What a factor and a solution cost as a band and by nested dissection, in one run.

python benchmarks/factors.py                        # 2 minutes
python benchmarks/factors.py --sizes 17 --repeats 200

The matrix is that of a square sheet with the default elements, of random numbers.
"""

import argparse

import jax
import jax.numpy as jnp
import measure
import numpy as np

import r2s
from r2s.cloth.linear.band import Band
from r2s.cloth.linear.dissection import levels
from r2s.cloth.linear.elimination import Elimination
from r2s.cloth.linear.factor import factor, solve

KINDS = ("band", "dissection")
TIMES = ("factor", "indefinite", "solution")


def matrix(pattern) -> jax.Array:
    """Blocks of a symmetric positive definite matrix."""
    rows, columns = np.asarray(pattern.rows), np.asarray(pattern.columns)
    blocks = np.random.default_rng(0).normal(size=(len(rows), 3, 3))
    transposed = np.lexsort((rows, columns))  # the block of each block's place across the diagonal
    blocks = blocks + blocks[transposed].transpose(0, 2, 1)
    blocks[np.asarray(pattern.diagonal)] += 100 * np.eye(3)
    return jnp.asarray(blocks, float)


def calls_of(order, blocks: jax.Array, right: jax.Array):
    """The calls that are timed, compiled."""
    jobs = {
        "factor": (lambda blocks: factor(order, blocks), blocks),
        "indefinite": (lambda blocks: factor(order, blocks, is_definite=False), blocks),
    }
    factors = jax.jit(jobs["factor"][0])(blocks)
    jobs["solution"] = (lambda right: solve(order, factors, right), right)
    compiled = {name: (jax.jit(f).lower(x).compile(), x) for name, (f, x) in jobs.items()}
    return {name: (lambda call=call, x=x: call(x)) for name, (call, x) in compiled.items()}


def main(options: argparse.Namespace) -> None:
    print(", ".join(f"{name}: {value}" for name, value in measure.machine().items()))
    rows: list[measure.Row] = []
    for size in options.sizes:
        mesh = r2s.rectangle((0.45, 0.45), (size, size))
        pattern = Elimination.make(mesh).pattern
        places = np.asarray(mesh.rest), np.asarray(pattern.rows), np.asarray(pattern.columns)
        orders = {"band": Band.make(*places), "dissection": levels(*places)}
        right = jnp.asarray(np.random.default_rng(1).normal(size=(len(mesh.rest), 3)), float)
        calls = {kind: calls_of(orders[kind], matrix(pattern), right) for kind in KINDS}
        row: measure.Row = {"size": size, "width": orders["band"].width}
        for name in TIMES:
            times = measure.in_turn([calls[kind][name] for kind in KINDS], options.repeats)
            row |= {f"{kind} {name}": found for kind, found in zip(KINDS, times, strict=True)}
        rows.append(row)
    columns = {name: (lambda row, name=name: f"{row[name]}") for name in ("size", "width")}
    for name in TIMES:
        columns[f"{name} ms"] = lambda row, name=name: (
            f"{1e3 * row[f'band {name}']:.3g} ({1e3 * row[f'dissection {name}']:.3g})"
        )
    measure.show("Square sheets by vertices a side: band (nested dissection)", rows, columns)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Time factors of the matrix of a sheet.")
    parser.add_argument("--sizes", nargs="+", type=int, default=[9, 17, 33, 65, 97])
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--cores", type=int, default=1, help="to run on; 0: all")
    chosen = parser.parse_args()
    measure.keep_to(chosen.cores)
    main(chosen)
