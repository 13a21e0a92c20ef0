"""Guards against releases of jax that compute wrong numbers (0.10.2: jax-ml/jax#39103)."""

from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import keep_programs
from jax.experimental.compilation_cache import compilation_cache


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_jitted_vmap_over_many_points_is_right(dtype):
    random = np.random.default_rng(0)
    matrix = random.normal(size=(3, 3)).astype(dtype)
    points = random.normal(size=(65_536, 3)).astype(dtype)
    square = jax.jit(jax.vmap(lambda p: jnp.sum((jnp.asarray(matrix) @ p) ** 2)))
    found = np.asarray(square(points))
    assert found.dtype == dtype
    exact = np.sum((points.astype(float) @ matrix.astype(float).T) ** 2, axis=1)
    # a few roundings; cancellation in the products makes them relative to the operands
    scale = np.sum((np.abs(points) @ np.abs(matrix.T)) ** 2, axis=1)
    assert np.all(np.abs(found - exact) <= 8 * np.finfo(dtype).eps * scale)


@pytest.fixture
def programs(tmp_path: Path) -> Iterator[Path]:
    """An empty folder in which compiled programs are kept, instead of that of the tests."""
    before = {name: getattr(jax.config, name) for name in (FOLDER, LEAST)}
    compilation_cache.reset_cache()
    keep_programs(str(tmp_path))
    jax.config.update(LEAST, 0.0)
    yield tmp_path
    compilation_cache.reset_cache()
    for name, value in before.items():
        jax.config.update(name, value)


FOLDER, LEAST = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"


@pytest.mark.parametrize("damage", [lambda _: b"", lambda whole: whole[: len(whole) // 2]])
def test_a_damaged_file_of_a_program_is_compiled_again(programs, damage):
    ones = jnp.ones(3)

    def run():
        return float(jax.jit(lambda x: jnp.sum(x) + 41)(ones))  # a new function: nothing is known

    assert run() == 44
    files = list(programs.glob("*-cache"))
    assert files
    for file in files:
        file.write_bytes(damage(file.read_bytes()))
    with pytest.warns(UserWarning, match="persistent compilation cache"):
        assert run() == 44
