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

from r2s.estimation.pinn.losses import (
    Losses,
    Points,
    Scales,
    common_losses,
    field,
    gradients,
    load,
)
from r2s.estimation.pinn.network import WEAK, DisplacementField, T
from r2s.estimation.pinn.pulls import Pull
from r2s.estimation.pinn.stress import Strain, green, nominal_stress
from r2s.fabrics.fabric import Fabric

NODES = 12  # of the quadrature along each side
DEGREES = (7, 8)  # number of polynomials along and across the pull
FEW_NODES, FEW_DEGREES = 8, (3, 4)  # the same in the loss of the network


class Virtual(NamedTuple):
    """Virtual displacements on the unit square, at the nodes of a quadrature.

    The last one grows evenly from clamp to clamp; the others vanish at both.

    - `nodes`, `weights`: of the quadrature.
    - `value`, `slope`: of the functions, and in both sides, [-].
    """

    nodes: Float[Array, "node 2"]
    weights: Float[Array, " node"]
    value: Float[Array, "function node"]
    slope: Float[Array, "function node 2"]


def virtual_fields(degrees: tuple[int, int] = DEGREES, nodes: int = NODES) -> Virtual:
    """Products x (1 - x) P_i(x) P_j(y) of Legendre polynomials, scaled to a mean slope of 1."""
    at, weight = np.polynomial.legendre.leggauss(nodes)
    x, y = (grid.ravel() for grid in np.meshgrid((at + 1) / 2, (at + 1) / 2, indexing="ij"))
    weights = np.outer(weight, weight).ravel() / 4
    value, slope = virtual_at(np.stack([x, y], 1), degrees)
    size = np.sqrt(np.einsum("fqi,q->f", slope**2, weights))
    value, slope = value / size[:, None], slope / size[:, None, None]
    parts = np.stack([x, y], 1), weights, value, slope
    return Virtual(*(jnp.asarray(part, float) for part in parts))


def virtual_at(
    places: np.ndarray, degrees: tuple[int, int]
) -> tuple[Float[np.ndarray, "function point"], Float[np.ndarray, "function point 2"]]:
    """Values and slopes of the functions of `virtual_fields`, not scaled, at any places."""
    x, y = places.T
    along = [_legendre(i) * np.polynomial.Polynomial([0, 1, -1]) for i in range(degrees[0])]
    across = [_legendre(j) for j in range(degrees[1])]
    pairs = [(f, g) for f in along for g in across]
    pairs.append((np.polynomial.Polynomial([0, 1]), np.polynomial.Polynomial([1])))
    value = np.array([f(x) * g(y) for f, g in pairs])
    slope = np.array([[f.deriv()(x) * g(y), f(x) * g.deriv()(y)] for f, g in pairs])
    return value, np.moveaxis(slope, 1, 2)


def _legendre(degree: int) -> np.polynomial.Polynomial:
    """Legendre polynomial on 0..1."""
    basis = np.polynomial.legendre.Legendre.basis(degree, [0, 1])
    return basis.convert(kind=np.polynomial.Polynomial)


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
    jet = field(network, pull, places, jnp.repeat(frames, nodes), WEAK)
    rate = jnp.moveaxis(jet.second[:2], 0, -1)
    parts = gradients(jet), rate, jet.first[T], jet.second[2]
    return Kinematics(*(part.reshape(number, nodes, *part.shape[1:]) for part in parts))


def virtual_work(
    fabric: Fabric, pull: Pull, virtual: Virtual, motion: Kinematics, strain: Strain = green
) -> Float[Array, "frame function axis"]:
    """Work [N m / m] of stress and load in every virtual displacement and frame.

    In balance it is zero for all but the last one. There it is the force on the far clamp [N] times
    the value of that displacement at the clamp, see `end_value`.
    """

    def stresses(gradient, rate, velocity, acceleration):
        stress = nominal_stress(fabric, pull.angle, gradient, rate, strain)
        return stress, load(fabric, pull, velocity, acceleration)

    stress, loads = jax.vmap(jax.vmap(stresses))(*motion)
    weights = virtual.weights * pull.size[0] * pull.size[1]
    slope = virtual.slope / pull.size[None, None]
    inner = jnp.einsum("q,tqij,fqj->tfi", weights, stress, slope)
    return inner + jnp.einsum("q,tqi,fq->tfi", weights, loads, virtual.value)


def end_value(virtual: Virtual) -> Float[Array, ""]:
    """Value [-] of the last virtual displacement at the far clamp."""
    return virtual.slope[-1, 0, 0]


def weak_losses(
    network: DisplacementField,
    pull: Pull,
    fabric: Fabric,
    points: Points,
    scales: Scales,
    strain: Strain = green,
) -> Losses:
    """The losses with the virtual work in place of the equation of motion and of free edges.

    It is tested in the frames `points.edge_frame`; the other points are not used.
    """
    data, clamps = common_losses(network, pull, scales)
    virtual = virtual_fields(FEW_DEGREES, FEW_NODES)
    motion = kinematics(network, pull, virtual, points.edge_frame)
    work = virtual_work(fabric, pull, virtual, motion, strain)
    off = work[:, :-1] / (scales.stress * jnp.max(pull.size))
    traction = jnp.zeros((), data.dtype)
    if pull.force is not None:
        force = work[:, -1, 0] / end_value(virtual)
        traction = jnp.mean(((force - pull.force[points.edge_frame]) / scales.force) ** 2)
    return Losses(data, jnp.mean(off**2), traction, jnp.zeros((), data.dtype), clamps)
