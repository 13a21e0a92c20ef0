"""A sweep is the loop over its members: in chunks, resumed, and on several processes."""

import json
import os
import socket
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r2s.solvers.sweep import stream, sweep


def power(member):
    """Has a loop that begins with a constant, as simulations do."""
    total, _ = jax.lax.scan(lambda c, _: (c * member["a"] + 1, None), jnp.ones(()), length=3)
    return {"total": total, "pair": jnp.stack([member["a"], member["b"]])}


def members_of(count):
    return {"a": np.linspace(0.0, 1.0, count), "b": np.arange(float(count))}


@pytest.mark.slow(group="cloth")
@settings(max_examples=15, deadline=None)
@given(count=st.integers(1, 9), chunk=st.integers(1, 12))
def test_a_sweep_is_the_loop_over_its_members(count, chunk):
    members = members_of(count)
    found = sweep(power, members, chunk)
    alone = [power({name: jnp.asarray(v[i]) for name, v in members.items()}) for i in range(count)]
    for name in ("total", "pair"):
        np.testing.assert_allclose(found[name], np.stack([a[name] for a in alone]), rtol=1e-14)


def test_a_chunk_that_does_not_fit_memory_is_refused_before_it_runs(monkeypatch):
    calls = []

    def counted(member):
        jax.debug.callback(lambda: calls.append(1))
        return jnp.outer(member["a"] + jnp.arange(1000.0), jnp.arange(1000.0)).sum(0)

    monkeypatch.setattr("r2s._util.threads.available", lambda: 10_000)
    with pytest.raises(MemoryError, match=r"a chunk of 4 members needs .* GB.*below 4"):
        sweep(counted, members_of(8), chunk=4)
    assert not calls
    monkeypatch.setattr("r2s._util.threads.available", lambda: None)  # nobody says
    assert sweep(counted, members_of(8), chunk=4).shape == (8, 1000)
    assert len(calls) == 2  # once a chunk


def test_an_interrupted_sweep_goes_on_where_it_was(tmp_path):
    calls = []

    def counted(member):
        jax.debug.callback(lambda a: calls.append(float(a)), member["a"])
        return power(member)

    members = members_of(6)
    running = stream(counted, members, 2, folder=tmp_path)
    for _ in range(2):
        next(running)
    jax.effects_barrier()
    assert len(calls) == 4
    found = sweep(counted, members, 2, folder=tmp_path)
    jax.effects_barrier()
    assert len(calls) == 6  # the first two chunks were read
    np.testing.assert_array_equal(found["pair"], sweep(power, members)["pair"])
    other = members | {"b": np.full(6, 7.0)}  # is not read
    np.testing.assert_array_equal(sweep(power, other, 2, folder=tmp_path)["pair"][:, 1], 7.0)


def test_members_of_different_lengths_are_refused():
    with pytest.raises(ValueError, match=r"one leading axis.*\(2,\), \(3,\)"):
        sweep(power, {"a": np.ones(2), "b": np.ones(3)})
    with pytest.raises(ValueError, match="one leading axis"):
        sweep(power, {"a": np.ones(()), "b": np.ones(())})


PROCESS = """
import json, sys
import jax
count, index, port, out = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3], sys.argv[4]
jax.config.update("jax_num_cpu_devices", 4 // count)
if count > 1:
    jax.distributed.initialize(f"127.0.0.1:{port}", count, index)
import jax.numpy as jnp
import numpy as np
import dataclasses
import r2s
from r2s import presets
from r2s.solvers.sweep import sweep

sheet = r2s.rectangle((0.2, 0.2), (3, 3))
solver = r2s.ImplicitCloth(r2s.Scene(sheet, [0]), dt=0.02)
start = jnp.concatenate([sheet.rest, jnp.zeros((9, 1))], axis=1)
still = r2s.Control(jnp.broadcast_to(start[0], (6, 1, 3)))

def lowest(density):
    fabric = presets.grey_interlock()
    fabric = dataclasses.replace(fabric, density=density)
    moved = r2s.simulate(solver, fabric, solver.init(start), still)
    return {"x": moved.x[-1], "ok": moved.ok}

found = sweep(lowest, jnp.linspace(0.1, 0.3, 6), 4)
assert jax.device_count() == 4
if index == 0:
    np.savez(out, **found)
"""


@pytest.mark.slow(group="study")
def test_two_processes_sweep_as_one_does(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])

    def start(count, index, out):
        command = [sys.executable, "-c", PROCESS, str(count), str(index), port, str(out)]
        return subprocess.Popen(command, env=os.environ | {"JAX_PLATFORMS": "cpu"})

    together = [start(2, index, tmp_path / "two.npz") for index in range(2)]
    assert [process.wait(400) for process in together] == [0, 0]
    assert start(1, 0, tmp_path / "one.npz").wait(400) == 0
    with np.load(tmp_path / "one.npz") as one, np.load(tmp_path / "two.npz") as two:
        assert one["ok"].all() and json.dumps(sorted(one)) == json.dumps(sorted(two))
        assert np.ptp(one["x"][:, :, 2], axis=0).max() > 1e-5  # they differ by their density
        np.testing.assert_array_equal(one["x"], two["x"])
