"""Calls on threads give what calls one after the other give."""

import threading
import time

import jax
import jax.numpy as jnp
import pytest

from r2s import kept, side_by_side


@pytest.fixture
def two_cores(monkeypatch):
    monkeypatch.setattr(side_by_side, "cores", lambda: 2)


def test_calls_run_at_the_same_time_and_come_in_order(two_cores):
    both = threading.Barrier(2)

    def waits_for_the_other(number):
        both.wait(timeout=10)
        return 2 * number

    assert side_by_side.side_by_side(waits_for_the_other, range(6)) == [0, 2, 4, 6, 8, 10]


def test_within_a_call_others_come_one_after_the_other(two_cores):
    def threads(_):
        return side_by_side.side_by_side(lambda _: threading.get_ident(), range(3))

    found = side_by_side.side_by_side(threads, range(4))
    assert all(len(set(each)) == 1 for each in found)
    assert threading.get_ident() not in found[0]


def test_an_error_is_raised_and_what_has_not_begun_is_left_out(two_cores):
    begun = []

    def fails_at_first(number):
        begun.append(number)
        if number == 0:
            raise ValueError("number 0")
        time.sleep(0.2)

    with pytest.raises(ValueError, match="number 0"):
        side_by_side.side_by_side(fails_at_first, range(50))
    assert len(begun) < 50


@pytest.mark.parametrize("is_double", [False, True])
def test_precision_is_that_of_the_caller(two_cores, is_double):
    with jax.enable_x64(is_double):
        found = side_by_side.side_by_side(lambda x: jnp.zeros(x).dtype, [1, 2])
    assert found == [jnp.float64 if is_double else jnp.float32] * 2


def test_on_one_core_the_caller_works_alone(monkeypatch):
    monkeypatch.setattr(side_by_side, "cores", lambda: 1)
    found = side_by_side.side_by_side(lambda _: threading.get_ident(), range(3))
    assert set(found) == {threading.get_ident()}
    made = []
    with side_by_side.meanwhile([lambda: made.append(1)]):
        pass
    assert made == []


def test_meanwhile_another_thread_works_until_the_body_ends(two_cores):
    began, end, made = threading.Event(), threading.Event(), []

    def first():
        began.set()
        end.wait(timeout=10)
        raise ValueError("which the body would meet itself")

    with side_by_side.meanwhile([first, lambda: made.append(1)]):
        assert began.wait(timeout=10)  # while the body is here
    end.set()
    assert made == []  # it had not begun


def test_two_threads_that_call_a_kept_function_first_trace_it_once(two_cores):
    traced = []

    @kept.kept
    def doubled(x):
        traced.append(x)
        time.sleep(0.1)
        return 2 * x

    found = side_by_side.side_by_side(doubled, [jnp.ones(3), 2 * jnp.ones(3)])
    assert [each.tolist() for each in found] == [[2.0] * 3, [4.0] * 3]
    assert len(traced) == 1
