#!/bin/sh
# On a CPU of several cores XLA shares out even a loop over 512 elements (0.1 ms) over its threads, if
# it counts enough operations in it, as in a physics step whose element function is long. The threads
# then wait for each other. What is often recommended for one thread, XLA_FLAGS with
# --xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1, changes neither the size of the
# pool nor the compiled program. The environment variable NPROC does: it is read for the size of the
# pool when JAX makes its CPU device, and with NPROC=1 nothing is shared out.
#
# Seen with jax 0.10.1 on two cores: 2 threads and 1 shared loop by default and with these flags, 1 and
# 0 with NPROC=1. Needs Linux and two cores or more.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q jax==0.10.1 jaxlib==0.10.1
cat > "$folder/step.py" <<'PYTHON'
import os
import time

import jax
import jax.numpy as jnp


def stretched(x):
    """A long function of one element: its angle after many turns."""
    for _ in range(40):
        x = x - 0.1 * jnp.sin(x) * jnp.sqrt(1 + x * x)
    return x


steps = jax.jit(lambda x: jax.lax.fori_loop(0, 2000, lambda _, y: stretched(y), x))
x = jnp.linspace(0.1, 1.0, 512)
text = steps.lower(x).compile().as_text()
shared = text.count('outer_dimension_partitions":["')
steps(x).block_until_ready()
began = time.perf_counter()
steps(x).block_until_ready()
taken = time.perf_counter() - began
tasks = [open(f"/proc/self/task/{task}/comm").read().strip() for task in os.listdir("/proc/self/task")]
print(tasks.count("tf_XLAEigen"), shared, f"{taken:.2f} s")
PYTHON
run() { env "$@" JAX_PLATFORMS=cpu "$folder/venv/bin/python" "$folder/step.py"; }
usual=$(run A=)
flags=$(run XLA_FLAGS="--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
one=$(run NPROC=1)
echo "threads, shared loops, time of 2000 steps: by default $usual; with the flags $flags; NPROC=1 $one"
[ "$(nproc)" -ge 2 ] || { echo "one core: nothing to see"; exit 0; }
set -- $usual; [ "$1" -ge 2 ] && [ "$2" -ge 1 ] || { echo "it has changed: default"; exit 1; }
set -- $flags; [ "$1" -ge 2 ] && [ "$2" -ge 1 ] || { echo "it has changed: flags"; exit 1; }
set -- $one; [ "$1" -eq 1 ] && [ "$2" -eq 0 ] || { echo "it has changed: NPROC"; exit 1; }
