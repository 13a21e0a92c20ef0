"""The weak form of a sheet that hangs: work of its membrane, bending, weight and air.

The motion is a map (X, Y, t) to places, which the network gives. The virtual displacements are
quadratic B-splines, each zero but in a patch of the sheet. So patches which are held or on the
table can be left out, where unknown forces act. At free edges the traction is zero of itself.

All is in the axes of the sheet at rest: warp, weft and normal.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.interpolate import BSpline

from r2s.estimation.pinn.network import STRONG, DisplacementField, T, at_time
from r2s.estimation.pinn.stress import green
from r2s.fabrics.fabric import Fabric
from r2s.units import GRAVITY
from r2s.world.air import Air, Fan

SPANS, NODES = 8, 2  # along each side; Gauss nodes in a span
DEGREE = 2  # enough for curvatures


class Splines(NamedTuple):
    """Virtual displacements on the unit square, at the nodes of a quadrature.

    - `nodes`, `weights`: of the quadrature.
    - `value`, `slope`, `curve`: of the functions [-], first and second derivatives (XX, XY, YY).
    """

    nodes: Float[Array, "node 2"]
    weights: Float[Array, " node"]
    value: Float[Array, "function node"]
    slope: Float[Array, "function node 2"]
    curve: Float[Array, "function node 3"]


class Hanging(NamedTuple):
    """What acts on a sheet, in its axes at rest.

    - `size`: of the sheet, [m].
    - `down`: direction of gravity, [-].
    - `air`: its drag.
    - `fan`: where the wind blows; None: everywhere.
    - `wind`: its velocity, [m/s].
    """

    size: Float[Array, " 2"]
    down: Float[Array, " 3"]
    air: Air
    fan: Fan | None
    wind: Float[Array, " 3"]


def splines(spans: int = SPANS, nodes: int = NODES) -> Splines:
    """Products of quadratic B-splines with evenly spaced knots, repeated at the ends."""
    at, weight = np.polynomial.legendre.leggauss(nodes)
    places = ((np.arange(spans)[:, None] + (at + 1) / 2) / spans).ravel()
    weights = np.tile(weight / (2 * spans), spans)
    knots = np.concatenate([np.zeros(DEGREE), np.linspace(0, 1, spans + 1), np.ones(DEGREE)])
    spline = BSpline(knots, np.eye(spans + DEGREE), DEGREE)
    one = [spline(places) if d == 0 else spline.derivative(d)(places) for d in range(3)]

    def grid(along: int, across: int) -> np.ndarray:
        """Products of derivatives of some orders, at all nodes."""
        product = np.einsum("qi,rj->ijqr", one[along], one[across])
        return product.reshape((spans + DEGREE) ** 2, -1)

    x, y = np.meshgrid(places, places, indexing="ij")
    parts = (
        np.stack([x.ravel(), y.ravel()], 1),
        np.outer(weights, weights).ravel(),
        grid(0, 0),
        np.stack([grid(1, 0), grid(0, 1)], -1),
        np.stack([grid(2, 0), grid(1, 1), grid(0, 2)], -1),
    )
    return Splines(*(jnp.asarray(part, float) for part in parts))


def curvature(gradient: Float[Array, "3 2"], second: Float[Array, "3 3"]) -> Float[Array, " 3"]:
    """Curvatures (k11, k22, 2 k12) [1/m] of a map, from slopes [-] and derivatives XX, XY, YY."""
    across = jnp.cross(gradient[:, 0], gradient[:, 1])
    normal = across / jnp.sqrt(across @ across)
    along, twist, side = normal @ second
    return jnp.stack([along, side, 2 * twist])


def drag(
    hanging: Hanging, place: Float[Array, " 3"], slope: Float[Array, "3 2"], velocity
) -> Float[Array, " 3"]:
    """Drag of the air per area at rest [N/m^2]."""
    share = jnp.ones(1, place.dtype) if hanging.fan is None else hanging.fan(place[None])
    area = jnp.cross(slope[:, 0], slope[:, 1])
    return -jax.grad(hanging.air.dissipation)(velocity - share * hanging.wind, area)


def virtual_work(
    network: DisplacementField,
    hanging: Hanging,
    fabric: Fabric,
    parts: Splines,
    time: Float[Array, ""],
) -> Float[Array, "function 3"]:
    """Work [N] of all forces in every virtual displacement at a time [s]; zero in balance.

    Damping is left out, which is small in a slow motion.
    """
    places = parts.nodes * hanging.size[None]
    jet = network.jet(at_time(places, time), STRONG)
    flat = jnp.eye(3, 2, dtype=jet.value.dtype)
    gradient = jnp.moveaxis(jet.first[:2], 0, -1)
    second = jnp.moveaxis(jet.second[:3], 0, -1)
    at = jnp.pad(places, ((0, 0), (0, 1))) + jet.value

    def energy(gradient, second):
        bent = fabric.bending.energy_density(curvature(gradient + flat, second))
        return fabric.membrane.energy_density(green(gradient)) + bent

    def node(at, gradient, second, velocity, acceleration):
        stress, moment = jax.grad(energy, (0, 1))(gradient, second)
        free = fabric.density * (acceleration - GRAVITY * hanging.down)
        return stress, moment, free - drag(hanging, at, gradient + flat, velocity)

    stress, moment, load = jax.vmap(node)(at, gradient, second, jet.first[T], jet.second[3])
    weights = parts.weights * hanging.size[0] * hanging.size[1]
    x, y = hanging.size
    slope = parts.slope / hanging.size[None, None]
    curve = parts.curve / jnp.stack([x * x, x * y, y * y])[None, None]
    work = jnp.einsum("q,fq,qi->fi", weights, parts.value, load)
    work = work + jnp.einsum("q,fqj,qij->fi", weights, slope, stress)
    return work + jnp.einsum("q,fqj,qij->fi", weights, curve, moment)


def work_scale(
    hanging: Hanging, density: Float[Array, ""], parts: Splines
) -> Float[Array, " function"]:
    """Work [N] in virtual displacements of a stress as large as the sheet's weight makes it."""
    weights = parts.weights * hanging.size[0] * hanging.size[1]
    slope = jnp.sqrt(jnp.sum((parts.slope / hanging.size[None, None]) ** 2, axis=-1))
    longest = jnp.max(hanging.size)
    return density * GRAVITY * longest * (slope @ weights)


def loose(
    parts: Splines, held: Bool[Array, " 4"], low: Bool[Array, " node"]
) -> Bool[Array, " function"]:
    """Which virtual displacements are zero wherever unknown forces act.

    - `held`: which of the corners (0, 0), (1, 0), (0, 1), (1, 1) are held, with the span around.
    - `low`: nodes near the table.
    """
    corner = jnp.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]], parts.nodes.dtype)
    away = jnp.abs(parts.nodes[:, None] - corner[None])
    spans = round(len(parts.value) ** 0.5) - DEGREE
    near = jnp.all(away < 1 / spans, axis=2) & held[None]
    out = low | jnp.any(near, axis=1)
    touched = (jnp.abs(parts.value) > 0) & out[None]
    return ~jnp.any(touched, axis=1)
