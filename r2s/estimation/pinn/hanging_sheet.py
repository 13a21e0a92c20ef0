"""A sheet that hangs: the work of its membrane, bending, weight and air in local displacements.

The weak form in space, for a map (X, Y, t) to places that the network gives. The virtual
displacements are quadratic B-splines, each zero but in a patch of the sheet, so that patches which
are held or on the table can be left out: there forces act that nobody knows. Free edges need
nothing: their traction is zero of itself.

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

SPANS, NODES, DEGREE = 8, 2, 2  # along each side; Gauss nodes in a span; enough for curvatures


class Splines(NamedTuple):
    """Virtual displacements on the unit square, at the nodes of a quadrature.

    - `nodes`, `weights`: of the quadrature. - `value` [-], `slope`, `curve` (XX, XY, YY): with
      derivatives. - `corners`: value at the corners (0, 0), (1, 0), (0, 1), (1, 1).
    """

    nodes: Float[Array, "node 2"]
    weights: Float[Array, " node"]
    value: Float[Array, "function node"]
    slope: Float[Array, "function node 2"]
    curve: Float[Array, "function node 3"]
    corners: Float[Array, "function 4"]


class Hanging(NamedTuple):
    """What acts on a sheet, in its axes at rest.

    - `size`: [m]. - `down`: of gravity, [-]. - `air`. - `fan`, `wind`: [m/s]; None: still air.
    """

    size: Float[Array, " 2"]
    down: Float[Array, " 3"]
    air: Air
    fan: Fan | None
    wind: Float[Array, " 3"]


def splines(spans: int = SPANS, nodes: int = NODES) -> Splines:
    """Products of quadratic B-splines of even knots, repeated at the ends."""
    at, weight = np.polynomial.legendre.leggauss(nodes)
    places = ((np.arange(spans)[:, None] + (at + 1) / 2) / spans).ravel()
    weights = np.tile(weight / (2 * spans), spans)
    knots = np.concatenate([np.zeros(DEGREE), np.linspace(0, 1, spans + 1), np.ones(DEGREE)])
    spline = BSpline(knots, np.eye(spans + DEGREE), DEGREE)
    one = [spline(places) if d == 0 else spline.derivative(d)(places) for d in range(3)]
    grid = lambda a, b: np.einsum("qi,rj->ijqr", a, b).reshape((spans + DEGREE) ** 2, -1)
    x, y = np.meshgrid(places, places, indexing="ij")
    ends = spline(np.array([0.0, 1.0]))
    array = lambda values: jnp.asarray(values, float)
    return Splines(
        array(np.stack([x.ravel(), y.ravel()], 1)),
        array(np.outer(weights, weights).ravel()),
        array(grid(one[0], one[0])),
        array(np.stack([grid(one[1], one[0]), grid(one[0], one[1])], -1)),
        array(np.stack([grid(one[2], one[0]), grid(one[1], one[1]), grid(one[0], one[2])], -1)),
        array(np.einsum("ei,fj->ijfe", ends, ends).reshape(-1, 4)),
    )


def curvature(gradient: Float[Array, "3 2"], second: Float[Array, "3 3"]) -> Float[Array, " 3"]:
    """(k11, k22, 2 k12) [1/m] of a map, from its slopes [-] and second derivatives XX, XY, YY."""
    across = jnp.cross(gradient[:, 0], gradient[:, 1])
    normal = across / jnp.sqrt(across @ across)
    along, twist, side = normal @ second
    return jnp.stack([along, side, 2 * twist])


def drag(
    hanging: Hanging, place: Float[Array, " 3"], slope: Float[Array, "3 2"], velocity
) -> Float[Array, " 3"]:
    """Of the air, on an area at rest [N/m^2]."""
    share = jnp.ones(1, place.dtype) if hanging.fan is None else hanging.fan(place[None])
    area = jnp.cross(slope[:, 0], slope[:, 1])
    flow = lambda velocity: hanging.air.dissipation(velocity - share * hanging.wind, area)
    return -jax.grad(flow)(velocity)


def virtual_work(
    network: DisplacementField,
    hanging: Hanging,
    fabric: Fabric,
    parts: Splines,
    time: Float[Array, ""],
) -> Float[Array, "function 3"]:
    """The work [N] per virtual displacement of all forces at a time [s]; zero in balance.

    Without damping, which in a slow motion is small.
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
    """The work [N] of the stress that the weight of the sheet makes, in virtual displacements."""
    weights = parts.weights * hanging.size[0] * hanging.size[1]
    slope = jnp.sqrt(jnp.sum((parts.slope / hanging.size[None, None]) ** 2, axis=-1))
    longest = jnp.max(hanging.size)
    return density * GRAVITY * longest * (slope @ weights)


def loose(
    parts: Splines, held: Bool[Array, " 4"], low: Bool[Array, " node"]
) -> Bool[Array, " function"]:
    """Virtual displacements that are zero where the sheet is held or `low`, near the table.

    `held`: which corners (0, 0), (1, 0), (0, 1), (1, 1). In the span around one forces are
    unknown: it counts as held too.
    """
    corner = jnp.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]], parts.nodes.dtype)
    away = jnp.abs(parts.nodes[:, None] - corner[None])
    spans = round(len(parts.value) ** 0.5) - DEGREE
    near = jnp.all(away < 1 / spans, axis=2) & held[None]
    out = low | jnp.any(near, axis=1)
    touched = (jnp.abs(parts.value) > 0) & out[None]
    return ~jnp.any(touched, axis=1)
