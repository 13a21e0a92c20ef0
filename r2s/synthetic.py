"""Synthetic recordings: a known fabric, moved by the solver and seen by a camera.

They come from the same solver, mesh and step as the estimates made from them. So they test the
estimators, not the solver: the error on a real fabric is larger.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.fabric import Fabric
from r2s.observe.camera import Camera
from r2s.recording import Recording, RecordingInfo, SheetPlacement, corner, make_recording
from r2s.scenario import from_placement, motion
from r2s.surface import sample

SIDE = 0.45  # [m], the study's sheets
NUM_FRAMES, FRAME_RATE = 60, 15.0  # the study's
SAMPLES = 10  # squared, on each face
POINTS = 2000  # a frame
NOISE = 1e-3  # [m], standard deviation
OUTLIERS = 0.01  # of the points
MARGIN = 0.004  # [m] above the table, below which a camera cannot tell sheet from table


def lift(fabric: Fabric, name: str, trial: int, *, key: PRNGKeyArray) -> Recording:
    """A recording of one corner lifted from the table by 0.35 m and drawn inward.

    `trial` names the repetition, `key` its noise and the 2 mm by which its path differs. Raises
    `RuntimeError` when the simulation diverges.
    """
    inward = 0.15 / np.sqrt(2)
    knots = [(0.0, 0.0, 0.002), (0.5 * inward, 0.5 * inward, 0.2), (inward, inward, 0.35)]
    return _record(fabric, name, "lift", trial, "origin", knots, (30, 59), key)


def fold(fabric: Fabric, name: str, trial: int, *, key: PRNGKeyArray) -> Recording:
    """A recording of one corner brought over to the opposite one; otherwise as `lift`."""
    angles = np.linspace(0, np.pi, 9)
    reach, height = 0.46 * SIDE, 0.5 * SIDE
    knots = [(reach * (1 - np.cos(a)), reach * (1 - np.cos(a)), height * np.sin(a)) for a in angles]
    knots = [(x, y, max(z, 0.01)) for x, y, z in knots]
    return _record(fabric, name, "fold", trial, "origin", knots, (15, 59), key)


def placement(held: str) -> SheetPlacement:
    """The study's square sheet, flat on a table at z = 0, held at a named corner."""
    return SheetPlacement((SIDE, SIDE), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (held,))


def cameras() -> tuple[Camera, Camera]:
    """Two depth cameras in front of the sheet, one from the left and one from above."""
    target = jnp.array([0.25, 0.25, 0.1], float)
    positions = [(-0.5, -0.1, 0.5), (0.1, -0.4, 0.9)]
    return tuple(Camera(jnp.array(p, float), target) for p in positions)  # pyright: ignore


def _record(fabric, name, scenario, trial, held, knots, frames_used, key) -> Recording:
    key_path, key_view = jr.split(key)
    sheet = placement(held)
    # a smooth start and stop, at rest for the last second
    times = np.arange(NUM_FRAMES) / FRAME_RATE
    progress = np.clip(times / (times[-1] - 1), 0, 1)
    progress = progress**2 * (3 - 2 * progress)
    along = np.linspace(0, 1, len(knots))
    path = np.stack([np.interp(progress, along, axis) for axis in np.array(knots).T], axis=1)
    path = path + corner(sheet, held) + 2e-3 * np.asarray(jr.normal(key_path, (3,))) * [1, 1, 0]
    clouds = _clouds(fabric, sheet, path, times, name, key_view)
    info = RecordingInfo(
        name=f"{scenario}_{name}{trial if trial > 1 else ''}",
        scenario=scenario,
        fabric=name,
        trial=str(trial),
        source=f"synthetic: {name}, camera noise {1e3 * NOISE:g} mm, {OUTLIERS:.0%} outliers",
        frames_used=frames_used,
        sheet=sheet,
        table_height=0.0,
        verified=None,
    )
    return make_recording(clouds, times, path, times, info)


def _clouds(fabric, sheet, path, times, name, key) -> list[np.ndarray]:
    scenario = from_placement(
        sheet, 0.0, jnp.asarray(path, float)[:, None], jnp.asarray(times, float), times
    )
    moved = _motion(scenario, fabric)
    if not bool(jnp.all(moved.ok)):
        first = int(jnp.argmin(moved.ok))
        raise RuntimeError(f"the simulation of {name} diverged in frame {first}: positions")
    points, seen = _observe(moved.x, scenario.scene.mesh.faces, jr.split(key, len(times)))
    points, seen = np.asarray(points), np.asarray(seen)
    return [cloud[visible] for cloud, visible in zip(points, seen, strict=True)]


_motion = eqx.filter_jit(motion)


@jax.jit
def _observe(x, faces, keys):
    return jax.vmap(_observe_frame, in_axes=(0, None, 0))(x, faces, keys)


def _observe_frame(x: Float[Array, "vertex 3"], faces, key):
    """Noisy points of the surface, and which of them the cameras record."""
    key_pick, key_noise, key_where = jr.split(key, 3)
    surface = sample(x, faces, SAMPLES)
    seen = jnp.any(jnp.stack([camera.sees(surface) for camera in cameras()]), axis=0)
    seen = seen & (surface[:, 2] > MARGIN)
    # a random order with what is seen in front: its first points are a random choice of the seen
    order = jnp.argsort(jr.uniform(key_pick, seen.shape, float) + (~seen).astype(float))[:POINTS]
    points = surface[order] + NOISE * jr.normal(key_noise, (POINTS, 3), float)
    low, high = jnp.array([-0.1, -0.1, 0.0], float), jnp.array([0.6, 0.6, 0.5], float)
    stray = low[None] + (high - low)[None] * jr.uniform(key_where, (POINTS, 3), float)
    # one in a hundred, and three at least: a sheet flat on the table gives nothing else
    strays = jnp.maximum(3, OUTLIERS * jnp.sum(seen[order], dtype=float))
    is_stray = jnp.arange(POINTS, dtype=float) >= POINTS - strays
    return jnp.where(is_stray[:, None], stray, points), seen[order] | is_stray
