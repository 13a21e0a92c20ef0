"""How long do motions of an estimate take one after the other, and side by side on threads?

python benchmarks/side_by_side.py --out results/side_by_side.json     # five minutes, idle

A lift of 60 frames of grey interlock, at places of the range that are drawn once, and its
derivatives in seven parameters. Wall and CPU seconds of one of them, without compilation; with as
many threads of OpenBLAS as there are cores, which is its own choice, and with one. Side by side is
`r2s.threads`. Every line is of a process of its own, since OpenBLAS asks once.
"""

import argparse
import json
import os
import shlex
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import measure
from measure import Row

from r2s import files, scenarios
from r2s.estimation import compiled, gauss_newton
from r2s.estimation.default_spaces import on_cloth
from r2s.estimation.problem import Problem
from r2s.fabrics import presets
from r2s.scenarios import synthetic
from r2s.threads import cores, thread_map

PLACES = 12


def measured(side: int) -> list[Row]:
    """The lines of a mesh in this process."""
    truth, shape = presets.grey_interlock(), (side, side)
    lift = synthetic.record(scenarios.lifting(), truth, "x", shape=shape, key=jax.random.key(0))
    problems = (Problem.make(lift, on_cloth(float(truth.density)), shape=shape),)
    size, dim = gauss_newton.theta_length(problems), problems[0].space.dim
    places = jax.random.uniform(jax.random.key(1), (PLACES, dim), minval=0.3, maxval=0.7)
    thetas = [jnp.zeros(size).at[:dim].set(place) for place in places]
    lines = []
    for what, at in (
        ("motion", compiled.predictions_at),
        ("derivatives", compiled.derivatives_at),
    ):

        def one(theta, at=at):
            return jax.block_until_ready(at(problems, theta))

        one(thetas[0])
        for how, run in (("one by one", map), ("side by side", thread_map)):
            wall, cpu = time.perf_counter(), time.process_time()
            list(run(one, thetas))
            spent = time.perf_counter() - wall, time.process_time() - cpu
            line = {"side": side, "what": what, "how": how, "cores": cores()}
            wall_s, cpu_s = (each / PLACES for each in spent)
            lines.append(line | {"wall_s": wall_s, "cpu_s": cpu_s})
    return lines


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--sizes", nargs="+", type=int, default=[9, 17])
    parser.add_argument("--out", type=Path, help="JSON file")
    parser.add_argument("--only", type=int, help="a mesh, in this process: JSON")
    a = parser.parse_args()
    if a.only:
        print(json.dumps(measured(a.only)))
        sys.exit()
    found = []
    for side in a.sizes:
        for threads in (str(os.cpu_count()), "1"):
            command = [sys.executable, __file__, "--only", str(side)]
            environment = os.environ | {"OPENBLAS_NUM_THREADS": threads}
            made = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True)
            for row in json.loads(made.stdout):
                found.append({"part": "side by side", "threads": threads} | row)
                print(found[-1], flush=True)
    if a.out:
        about = measure.machine() | {"command": shlex.join(["python", *sys.argv])}
        files.write_json(a.out, {"machine": about, "rows": found})
