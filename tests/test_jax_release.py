"""Guards against releases of jax that compute wrong numbers (0.10.2: jax-ml/jax#39103)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest


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
