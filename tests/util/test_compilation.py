"""Compiled programs: compiled once and ahead, kept in files, let go."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from jax.experimental.compilation_cache import compilation_cache

from r2s import compilation
from r2s.compilation import compile_once

SETTINGS = (
    "jax_compilation_cache_dir",
    "jax_compilation_cache_max_size",
    "jax_enable_compilation_cache",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)


@pytest.fixture
def settings(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Those of JAX as they were, after a test."""
    before = {name: getattr(jax.config, name) for name in SETTINGS}
    monkeypatch.setenv("JAX_ENABLE_COMPILATION_CACHE", "true")
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


def test_a_program_is_made_once_for_each_shape_and_static_part() -> None:
    traced = []

    @compile_once
    def scaled(x, times):
        traced.append(times)
        return x * times

    assert scaled(jnp.ones(3), 2).tolist() == [2.0] * 3
    assert scaled(4 * jnp.ones(3), 2).tolist() == [8.0] * 3
    assert traced == [2]
    assert scaled(jnp.ones(3), 3).tolist() == [3.0] * 3  # another static part, another program
    assert scaled(jnp.ones(2), 2).tolist() == [2.0] * 2
    assert traced == [2, 3, 2]


def test_equal_numbers_of_other_types_are_other_programs() -> None:
    """Which `equinox.filter_jit` takes for one (0.13.8, findings/filter_jit_equal_numbers.sh)."""
    full = compile_once(lambda value: jnp.full((2,), value))
    assert [full(value).dtype.kind for value in (1, 1.0, True)] == ["i", "f", "b"]


def test_a_compiled_function_is_differentiated_like_any_other() -> None:
    assert float(jax.grad(compile_once(lambda x: x**3))(2.0)) == pytest.approx(12.0)


def test_a_folder_that_cannot_be_made_is_one_warning(tmp_path: Path, settings: None) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.warns(UserWarning, match="programs are not kept: .*file.* --no-cache") as warned:
        assert compilation.keep(blocked) is None
    assert len(warned) == 1 and not compilation.is_kept()
    assert float(jax.jit(lambda x: x + 1)(jnp.ones(()))) == 2


def test_the_folder_is_that_of_the_user_and_of_this_machine(
    tmp_path: Path, settings: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    jax.config.update("jax_enable_compilation_cache", True)
    jax.config.update("jax_compilation_cache_dir", None)
    folder = compilation.keep()
    assert folder is not None and folder.name == compilation.machine()
    if sys.platform == "linux":
        assert folder.parent == tmp_path / "r2s" / "programs"


def test_to_import_r2s_leaves_the_cache_of_jax_alone() -> None:
    code = "import jax; before = dict(jax.config.values); import r2s, r2s.cli.main\n"
    code += f"assert all(jax.config.values[name] == before[name] for name in {SETTINGS})"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


@pytest.mark.slow(group="study")
@pytest.mark.skipif(sys.platform != "linux", reason="Linux alone counts mappings")
def test_a_program_takes_mappings_until_it_is_let_go() -> None:
    run = compile_once(lambda x: jnp.sin(2 * x).sum())
    compilation.clear()
    before = compilation.mappings()
    first = [float(run(jnp.ones(size))) for size in range(1, 21)]
    held = compilation.mappings()
    assert held >= before + 20
    compilation.clear()
    assert compilation.mappings() < held - 10
    assert [float(run(jnp.ones(size))) for size in range(1, 21)] == first


@pytest.mark.parametrize(("share", "goes"), [(0.4, False), (0.6, True)])
def test_programs_go_before_the_system_has_no_mapping_left(share, goes, monkeypatch) -> None:
    cleared = []
    monkeypatch.setattr(compilation, "clear", lambda: cleared.append(True))
    monkeypatch.setattr(compilation, "mappings", lambda: share * 65530)
    monkeypatch.setattr(compilation, "most_mappings", lambda: 65530.0)
    compilation.clear_in_time()
    assert bool(cleared) is goes
