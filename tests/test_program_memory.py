"""Compiled programs take mappings, of which a process may have so many and no more."""

import sys

import jax
import jax.numpy as jnp
import pytest

from r2s import program_memory
from r2s.kept import kept


@kept
def scaled(x, times):
    return jnp.sin(x * times).sum()


pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="mappings are told by Linux alone")


def compiled(count: int) -> None:
    for size in range(1, count + 1):
        scaled(jnp.ones(size), 2.0)


def test_a_program_takes_mappings_until_it_is_let_go():
    program_memory.let_go()
    before = program_memory.mappings()
    compiled(20)
    held = program_memory.mappings()
    assert held >= before + 20
    program_memory.let_go()
    assert program_memory.mappings() < held - 10


@pytest.mark.parametrize(("share", "goes"), [(0.4, False), (0.6, True)])
def test_programs_go_before_the_system_has_no_mapping_left(share, goes, monkeypatch):
    compiled(1)
    monkeypatch.setattr(program_memory, "mappings", lambda: share * 65530)
    monkeypatch.setattr(program_memory, "most_mappings", lambda: 65530.0)
    program_memory.let_go_in_time()
    assert bool(scaled._compiled or scaled._ready) is not goes


def test_where_the_system_tells_no_mappings_nothing_goes(monkeypatch, tmp_path):
    compiled(1)
    monkeypatch.setattr(program_memory, "MAPPED", tmp_path / "none")
    monkeypatch.setattr(program_memory, "MOST_MAPPED", tmp_path / "none")
    program_memory.let_go_in_time()
    assert scaled._compiled or scaled._ready


def test_numbers_are_the_same_after_programs_went():
    x = jax.random.normal(jax.random.key(0), (7,))
    first = scaled(x, 3.0)
    program_memory.let_go()
    assert float(scaled(x, 3.0)) == float(first)
