"""What clouds tell of a fabric beside a map in which forces do not quite balance."""

import importlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import r2s
from r2s.estimation.default_spaces import on_cloth

NOISE, VERTICES, DIM, FRAMES = 1e-3, 4, 3, 6


@pytest.fixture
def unbalanced(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "experiments"))
    return importlib.import_module("_unbalanced")


@pytest.fixture
def motion(unbalanced):
    """A stable linear motion of four vertices and three numbers of a fabric."""
    rng = np.random.default_rng(0)
    size = 12 * VERTICES
    state = [0.9 * np.linalg.qr(rng.normal(size=(size, size)))[0] for _ in range(FRAMES)]
    fabric = 0.05 * rng.normal(size=(FRAMES, size, DIM))
    push = 1e-3 * rng.normal(size=(FRAMES, size, 3 * VERTICES))
    normal = rng.normal(size=(FRAMES, VERTICES, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return unbalanced.Linear(
        0.05 * rng.normal(size=(size, DIM)), np.stack(state), fabric, push, normal
    )


PRIOR = np.diag([12.0, 12.0, 12.0])


def test_of_an_exact_motion_it_is_the_information_of_all_frames(unbalanced, motion):
    slope, information = motion.start, PRIOR.copy()
    for state, fabric, _, normal in zip(*motion[1:], strict=True):
        slope = state @ slope + fabric
        seen = np.einsum("vi,vid->vd", normal, slope[: 3 * VERTICES].reshape(VERTICES, 3, DIM))
        information += seen.T @ seen / NOISE**2
    expected = np.sqrt(np.diag(np.linalg.inv(information)))
    np.testing.assert_allclose(
        unbalanced.known(motion, PRIOR, NOISE, 0.0, False), expected, rtol=1e-3
    )


def test_the_less_forces_balance_the_less_is_told_and_never_less_than_is_known_before(
    unbalanced, motion
):
    before = np.sqrt(np.diag(np.linalg.inv(PRIOR)))
    for lasts in (False, True):
        told = [
            unbalanced.known(motion, PRIOR, NOISE, share, lasts) for share in (0.0, 0.1, 1.0, 1e4)
        ]
        assert (np.diff(told, axis=0) >= -1e-12).all()
        assert (told[-1] <= before * (1 + 1e-9)).all()


@pytest.mark.slow(group="pinn")
def test_slopes_of_a_motion_frame_by_frame_are_those_of_the_whole_motion(unbalanced):
    with jax.enable_x64(True):
        fabric = r2s.presets.grey_interlock()
        space = on_cloth(float(fabric.density))
        scenario = r2s.lifting(num_frames=6, interval=0.5).scenario((3, 3))
        place = jnp.asarray(space.to_unit(fabric), float)
        found = unbalanced.linear(scenario, space, place)
        slope = found.start
        for state, of_fabric in zip(found.state, found.fabric, strict=True):
            slope = state @ slope + of_fabric
        whole = jax.jit(jax.jacfwd(lambda place: r2s.rollout(scenario, space(place)).x[-1]))(place)
    expected = np.asarray(whole).reshape(-1, space.dim)
    np.testing.assert_allclose(slope[: len(expected)], expected, atol=1e-6 * np.abs(expected).max())
