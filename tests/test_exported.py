"""Exported fabrics move in other simulators as they do here. Needs r2s[bench]."""

import sys
from pathlib import Path

import jax
import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def exported(monkeypatch: pytest.MonkeyPatch):
    """The benchmark's module, as one that users run: in single precision, promotion as usual."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import exported  # pyright: ignore[reportMissingImports]

    with jax.enable_x64(False), jax.numpy_dtype_promotion("standard"):
        with jax.numpy_rank_promotion("allow"):
            exported._solver.cache_clear()
            yield exported
    exported._solver.cache_clear()


@pytest.mark.slow(group="motions")
@pytest.mark.parametrize("peer", ["mujoco", "newton"])
def test_an_exported_fabric_hangs_as_ours_does(exported, peer: str) -> None:
    if not exported.installed(peer):
        pytest.skip(f"{peer} is not installed: pip install 'r2s[bench]'")
    rows = exported.compare("isotropic", "drape", [peer])
    ours, *theirs = (row for row in rows if row["system"] == peer or "steps" in row["system"])
    assert ours["apart"] < 0.05 and len(theirs) == 2
    for row in theirs:
        assert np.isfinite(row["apart"]) and row["apart"] < 0.05 < row["moved"]


def test_what_is_held_goes_where_it_is_said(exported) -> None:
    start = np.zeros((exported.SIZE**2, 3))
    start[:, 2] = exported.HEIGHT
    for scene in exported.FRAMES:
        held, path = exported.path_of(scene, start)
        np.testing.assert_allclose(path(0.0), start[list(held)])
        np.testing.assert_allclose(path(1.0), path(9.0))
    assert "exported" in sys.modules
