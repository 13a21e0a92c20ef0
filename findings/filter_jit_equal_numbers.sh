#!/bin/sh
# equinox.filter_jit takes Python numbers that are equal for the same static argument, whatever their
# type: after a call with 1, calls with 1.0 and True run the program of 1. jax.jit with
# static_argnums tells them apart. So a function whose result depends on the type of a number (an
# exponent, a dtype, a branch on isinstance) gives another value by the order of calls.
#
# Seen with equinox 0.13.8, jax 0.10.1: half(1), half(1.0) is 1, 1; alone half(1.0) is 0.5.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q equinox==0.13.8 jax==0.10.1 jaxlib==0.10.1
"$folder/venv/bin/python" - <<'PYTHON'
import equinox
import jax
import jax.numpy as jnp


def half(x):
    """A float is halved, anything else is left."""
    return jnp.asarray(x / 2 if type(x) is float else x)


by_equinox, alone = equinox.filter_jit(half), equinox.filter_jit(lambda x: half(x))
by_jax = jax.jit(half, static_argnums=0)
print("equinox", equinox.__version__, "jax", jax.__version__)
print("filter_jit:", [str(by_equinox(x)) for x in (1, 1.0, True)], "alone:", alone(1.0))
print("jit, static_argnums:", [str(by_jax(x)) for x in (1, 1.0, True)])
assert float(by_equinox(1.0)) == 1.0 and by_equinox(True).dtype == jnp.int32, "it has changed"
assert float(alone(1.0)) == 0.5
assert float(by_jax(1.0)) == 0.5 and by_jax(True).dtype == jnp.bool_
PYTHON
