"""Calls on threads give what calls one after the other give."""

import os
import re
import subprocess
import sys
import threading
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r2s._util import threads
from r2s.compilation import compile_once
from r2s.estimation import gauss_newton


@pytest.fixture
def two_cores(monkeypatch):
    monkeypatch.setattr(threads, "threads", lambda: 2)


def test_calls_run_at_the_same_time_and_come_in_order(two_cores):
    both = threading.Barrier(2)

    def waits_for_the_other(number):
        both.wait(timeout=10)
        return 2 * number

    assert threads.thread_map(waits_for_the_other, range(6)) == [0, 2, 4, 6, 8, 10]


def test_within_a_call_others_come_one_after_the_other(two_cores):
    def inner(_):
        return threads.thread_map(lambda _: threading.get_ident(), range(3))

    calls = threads.thread_map(inner, range(4))
    assert all(len(set(call)) == 1 for call in calls)
    assert threading.get_ident() not in calls[0]


def test_an_error_is_raised_and_what_has_not_begun_is_left_out(two_cores):
    begun = []

    def fails_at_first(number):
        begun.append(number)
        if number == 0:
            raise ValueError("number 0")
        time.sleep(0.2)

    with pytest.raises(ValueError, match="number 0"):
        threads.thread_map(fails_at_first, range(50))
    assert len(begun) < 50


@pytest.mark.parametrize(
    "setting",
    [
        lambda: jax.enable_x64(not jax.config.jax_enable_x64),  # pyright: ignore
        lambda: jax.debug_nans(True),
        lambda: jax.default_matmul_precision("highest"),
    ],
)
def test_settings_of_the_calling_thread_hold(two_cores, setting):
    with setting():
        here = threads.settings()
        assert threads.thread_map(lambda _: threads.settings(), [1, 2]) == [here] * 2
    with np.errstate(divide="raise"):
        found = threads.thread_map(lambda _: np.geterr()["divide"], [1, 2])
    assert found == ["raise"] * 2


def test_the_caller_says_how_many_are_done(two_cores):
    reports = []

    def done(number):
        reports.append((number, threading.get_ident()))

    threads.thread_map(abs, range(4), done)
    assert reports == [(number, threading.get_ident()) for number in (1, 2, 3, 4)]


@pytest.mark.parametrize(("limit", "count"), [("1", 1), ("", 4), (" 1000 ", 4), ("3", 3)])
def test_the_environment_limits_the_threads(monkeypatch, limit, count):
    monkeypatch.setattr(threads, "cores", lambda: 4)
    monkeypatch.setenv(threads.LIMIT, limit)
    assert threads.threads() == count
    if count == 1:
        assert threads.thread_map(lambda _: threading.get_ident(), [0]) == [threading.get_ident()]


@pytest.mark.parametrize("limit", ["0", "many", "-1"])
def test_a_limit_that_is_none_is_refused(monkeypatch, limit):
    monkeypatch.setenv(threads.LIMIT, limit)
    with pytest.raises(ValueError, match="whole number from 1 on"):
        threads.threads()


def test_two_threads_that_call_a_function_first_trace_it_once(two_cores, monkeypatch):
    traced = []
    jit = eqx.filter_jit

    def slow_jit(function):  # so that both threads ask for a program before there is one
        time.sleep(0.05)
        return jit(function)

    monkeypatch.setattr(eqx, "filter_jit", slow_jit)

    @compile_once
    def doubled(x):
        traced.append(x)
        time.sleep(0.1)
        return 2 * x

    results = threads.thread_map(doubled, [jnp.ones(3), 2 * jnp.ones(3)])
    assert [result.tolist() for result in results] == [[2.0] * 3, [4.0] * 3]
    assert len(traced) == 1


def batches(function, *args):
    """Calls of LAPACK in a program that take a batch of matrices."""
    text = jax.jit(function).lower(*args).as_text()
    calls = [line for line in text.splitlines() if "custom_call @lapack" in line]
    assert calls
    return [line for line in calls if re.search(r"tensor<(?!1x)\d+x\d+x\d+xf", line)]


def test_what_runs_side_by_side_factors_no_batch_of_matrices():
    """Two programs that do wait for each other for ever, each in a thread of jaxlib's only pool."""
    scores, prior = jnp.ones((12, 5)), jnp.eye(5)
    matrices = jnp.broadcast_to(prior, (12, 5, 5))
    assert batches(jax.vmap(jnp.linalg.solve), matrices, scores)
    assert not batches(gauss_newton.scatter, scores, matrices, jnp.ones(12), prior, 1.0)


POOL = """
import os, sys
from r2s._util.threads import one_at_a_time
one_at_a_time()
import jax.numpy as jnp
jnp.zeros(3).block_until_ready()
names = [open(f"/proc/self/task/{task}/comm").read() for task in os.listdir("/proc/self/task")]
print(names.count("tf_XLAEigen\\n"))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="threads are counted in /proc")
@pytest.mark.parametrize("set_to", [None, "3"])
def test_xla_has_one_thread_where_no_other_number_is_set(set_to):
    """The names are of jaxlib 0.10.1."""
    known = {name: value for name, value in os.environ.items() if name != "NPROC"}
    own = known | ({} if set_to is None else {"NPROC": set_to})
    run = subprocess.run([sys.executable, "-c", POOL], capture_output=True, text=True, env=own)
    assert run.stdout.split() == [set_to or "1"], run.stderr
