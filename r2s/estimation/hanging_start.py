"""A hanging sheet that starts in the shape of its first cloud."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from r2s.materials.fabric import Fabric
from r2s.mesh.mesh import Mesh
from r2s.metrics.losses import TOUCHING, length, robust_weight, surface_residuals
from r2s.scenarios.scenario import Scenario, rollout

ROUNDS = 60  # of the registration
SMOOTH, STRETCHED = 0.02, 0.1  # weights of neighbours moving apart, and of edges growing longer

_rollout = eqx.filter_jit(rollout)


def start_as_seen(
    scenario: Scenario,
    fabric: Fabric,
    points: Float[Array, "point 3"],
    mask: Bool[Array, " point"],
) -> Scenario:
    """A scenario of a hanging sheet that starts in the shape of its first cloud (`points` [m]).

    A sheet whose corners are nearer to each other than they were cut buckles in one of several
    shapes, each at rest. Which one a simulation ends in depends on the fabric, and no descent
    crosses such a jump; near the observed shape, more fabrics come to rest in it (not all: for a
    stiff denim it fails on some recordings). `fabric`: any of those to be estimated, for the parts
    that the cloud does not show.
    """
    scene = scenario.scene
    alone = dataclasses.replace(scenario, num_frames=1, frame_times=None)
    first = _rollout(alone, fabric).x[0]
    start = registered(points, mask, first, scene.mesh, scene.is_free)
    path = scenario.path.at[0].set(scenario.path[1])
    return dataclasses.replace(scenario, start=start, path=path)


@eqx.filter_jit
def registered(
    points: Float[Array, "point 3"],
    mask: Bool[Array, " point"],
    x: Float[Array, "vertex 3"],
    mesh: Mesh,
    free: Bool[Array, " vertex"],
) -> Float[Array, "vertex 3"]:
    """The vertices `x` [m] of a sheet laid smoothly onto points [m], with edges as long as they
    were; only `free` vertices move.

    Nonrigid iterative closest points (Amberg, Romdhani and Vetter 2007), with distances to the
    surface, and outliers down-weighted.
    """
    edges = _edges(mesh, len(x))
    lengths = length(edges @ x)
    smooth = jnp.kron(SMOOTH * edges.T @ edges, jnp.eye(3, dtype=x.dtype))
    moving = jnp.repeat(free, 3)
    share = len(x) / jnp.maximum(jnp.sum(mask, dtype=x.dtype), 1)

    def closer(x: Array, _: None) -> tuple[Array, None]:
        distance, direction, vertices, weights = surface_residuals(points, mask, x, mesh.faces)
        shares = jnp.einsum("pk,pkv->pv", weights, jax.nn.one_hot(vertices, len(x), dtype=x.dtype))
        weight = share * jnp.where(mask, robust_weight(distance), 0)
        seen = _along(shares, direction)
        now = length(edges @ x)
        stretch = _along(edges, edges @ x / jnp.maximum(now, TOUCHING)[:, None])
        matrix = seen.T @ (weight[:, None] * seen) + smooth + STRETCHED * stretch.T @ stretch
        force = seen.T @ (weight * distance) - STRETCHED * stretch.T @ (now - lengths)
        matrix = jnp.where(moving[:, None] & moving[None], matrix, jnp.eye(len(matrix)))
        change = jnp.linalg.solve(matrix, jnp.where(moving, force, 0))
        return x + change.reshape(x.shape), None

    return jax.lax.scan(closer, x, length=ROUNDS)[0]


def _edges(mesh: Mesh, count: int) -> Float[Array, "edge vertex"]:
    """The matrix from vertices to the edges of the faces; inner edges count twice."""
    corner = jax.nn.one_hot(mesh.faces, count, dtype=float)
    return (corner - jnp.roll(corner, 1, axis=1)).reshape(-1, count)


def _along(
    shares: Float[Array, "row vertex"], direction: Float[Array, "row 3"]
) -> Float[Array, "row coordinate"]:
    """The derivative of shares of vertices along directions."""
    return jnp.einsum("rv,ri->rvi", shares, direction).reshape(len(shares), -1)
