"""The weak form: the work of stress and load in a few smooth virtual displacements.

The virtual displacements vanish at the clamps. They do not at the free edges, so that their balance
makes the traction there zero. One more virtual displacement grows evenly from clamp to clamp and
gives the balance with the measured force. First derivatives in space suffice. For a given motion
the work is linear in the stiffness (virtual fields method: Pierron and Grediac 2012).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.polynomial import Legendre, Polynomial

from r2s.estimation.pinn.losses import field, gradients, load
from r2s.estimation.pinn.network import DisplacementField, T, X, Y
from r2s.estimation.pinn.pulls import Pull
from r2s.estimation.pinn.stress import nominal_stress
from r2s.materials.fabric import Fabric

NODES = 12  # of the quadrature along each side
DEGREES = (7, 8)  # number of polynomials along and across the pull


class Virtual(NamedTuple):
    """Virtual displacements on the unit square, at the nodes of a quadrature.

    The last one grows evenly from clamp to clamp; the others vanish at both.

    - `nodes`, `weights`: of the quadrature.
    - `value`, `slope`: of the functions, and in both sides, [-].
    - `at_markers`: value of all but the last function at the markers, [-].
    """

    nodes: Float[Array, "node 2"]
    weights: Float[Array, " node"]
    value: Float[Array, "function node"]
    slope: Float[Array, "function node 2"]
    at_markers: Float[Array, "marker function"]


def virtual_fields(
    degrees: tuple[int, int] = DEGREES,
    nodes: int = NODES,
    markers: Float[np.ndarray, "marker 2"] | None = None,
) -> Virtual:
    """Products x (1 - x) P_i(x) P_j(y) of Legendre polynomials, scaled to a mean slope of 1.

    - `degrees`: number of polynomials along and across the pull.
    - `nodes`: of the quadrature along each side.
    - `markers`: their places on the unit square.
    """
    at, weight = np.polynomial.legendre.leggauss(nodes)
    places = np.stack(np.meshgrid((at + 1) / 2, (at + 1) / 2, indexing="ij"), -1).reshape(-1, 2)
    weights = np.outer(weight, weight).ravel() / 4
    along, across = ([_legendre(i) for i in range(count)] for count in degrees)
    pairs = [(f * Polynomial([0, 1, -1]), g) for f in along for g in across]
    pairs.append((Polynomial([0, 1]), Polynomial([1])))

    def values(functions, places) -> np.ndarray:
        x, y = places.T
        return np.array([f(x) * g(y) for f, g in functions])

    slopes = [values([(f.deriv(), g) for f, g in pairs], places)]
    slopes.append(values([(f, g.deriv()) for f, g in pairs], places))
    slope = np.stack(slopes, axis=2)
    size = np.sqrt(np.einsum("fqi,q->f", slope**2, weights))[:, None]
    at_markers = values(pairs, np.zeros((0, 2)) if markers is None else markers) / size
    parts = places, weights, values(pairs, places) / size, slope / size[..., None]
    return Virtual(*(jnp.asarray(part, float) for part in (*parts, at_markers[:-1].T)))


def _legendre(degree: int) -> Polynomial:
    """Legendre polynomial on 0..1."""
    return Legendre.basis(degree, [0, 1]).convert(kind=Polynomial)


class Kinematics(NamedTuple):
    """A motion at the nodes of a quadrature.

    - `gradient`, `rate`: of the displacement [-] and its rate [1/s].
    - `velocity`, `acceleration`: [m/s], [m/s^2].
    """

    gradient: Float[Array, "frame node axis 2"]
    rate: Float[Array, "frame node axis 2"]
    velocity: Float[Array, "frame node axis"]
    acceleration: Float[Array, "frame node axis"]


def kinematics(
    network: DisplacementField, pull: Pull, virtual: Virtual, frames: Int[Array, " frame"]
) -> Kinematics:
    """The motion of a network at the nodes in some frames."""
    number, nodes = len(frames), len(virtual.nodes)
    places = jnp.tile(virtual.nodes * pull.size[None], (number, 1))
    jet = field(network, pull, places, jnp.repeat(frames, nodes), ((X, T), (Y, T), (T, T)))
    rate = jnp.moveaxis(jet.second[:2], 0, -1)
    parts = gradients(jet), rate, jet.first[T], jet.second[2]
    return Kinematics(*(part.reshape(number, nodes, *part.shape[1:]) for part in parts))


def virtual_work(
    fabric: Fabric, pull: Pull, virtual: Virtual, motion: Kinematics
) -> Float[Array, "frame function axis"]:
    """Work [N m / m] of stress and load in every virtual displacement and frame.

    In balance it is zero for all but the last one. There it is the force on the far clamp [N] times
    the value of that displacement at the clamp, see `end_value`.
    """

    def stresses(gradient, rate, velocity, acceleration):
        stress = nominal_stress(fabric, pull.angle, gradient, rate)
        return stress, load(fabric, pull, velocity, acceleration)

    stress, loads = jax.vmap(jax.vmap(stresses))(*motion)
    weights = virtual.weights * pull.size[0] * pull.size[1]
    slope = virtual.slope / pull.size[None, None]
    inner = jnp.einsum("q,tqij,fqj->tfi", weights, stress, slope)
    return inner + jnp.einsum("q,tqi,fq->tfi", weights, loads, virtual.value)


def end_value(virtual: Virtual) -> Float[Array, ""]:
    """Value [-] of the last virtual displacement at the far clamp."""
    return virtual.slope[-1, 0, 0]
