"""Transfers between particles and grid: quadratic B-splines in 2-D and 3-D (MLS-MPM with APIC).

With w_ip the weight of node i for particle p, and d_ip = x_i - x_p,

    p2g:  node_i = sum_p w_ip (value_p + slope_p d_ip)
    g2p:  value_p = sum_i w_ip node_i,   moment_p = sum_i w_ip node_i d_ip

Each is the transpose of the other. Since sum_i w d d^T is spacing^2 / 4 times the identity, the
affine velocity matrix C of APIC is 4 / spacing^2 times the moment (Jiang, Schroeder, Selle, Teran
and Stomakhin 2015; Hu et al., "A moving least squares material point method", 2018).

Both work axis by axis (the weights are products over the axes), and with one row of nodes at a
time: 27 additions of (particle, channel) into the grid, which XLA makes in place, are fastest on
the CPU. Both have a rule of their own for the reverse mode: half the time of JAX's in 3-D.
`g2p_plain` and `p2g_plain` have none, so that they can be differentiated forward.
"""

import itertools
import math
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from r2s._util.arrays import once
from r2s.solvers.mpm.grid import Grid

Points = Float[Array, "particle axis"]
Values = Float[Array, "particle channel"]
Slopes = Float[Array, "particle channel axis"]
Nodes = Float[Array, "node channel"]
Columns = list[Float[Array, "_ _"]]  # (1, node) or (node, 1)


def affine_factor(grid: Grid) -> float:
    """The factor [1/m^2] from a moment of velocities [m^2/s] to the affine velocity [1/s]."""
    return 4 / grid.spacing**2


def p2g_plain(grid: Grid, x: Points, values: Values, slopes: Slopes) -> Nodes:
    """Sums at the nodes of values [unit] and slopes [unit/m] of particles at x [m].

    The stencil of a particle outside the grid is clipped to its border: see `Grid.inside`.
    """
    stencil = _Stencil(grid, x)
    nodes = jnp.zeros((math.prod(grid.shape), values.shape[1]), values.dtype)
    weighted = _p2g_axis(stencil.weights, *stencil.affine(values, slopes))
    for offset, part in zip(_offsets(grid), weighted, strict=True):
        nodes = nodes.at[stencil.first + offset].add(part, mode="promise_in_bounds")
    return nodes


def g2p_plain(grid: Grid, x: Points, nodes: Nodes) -> tuple[Values, Slopes]:
    """Weighted means [unit] and first moments [unit m] of a field around particles at x [m]."""
    stencil = _Stencil(grid, x)
    value, *moments = _g2p_axis(stencil.weights, stencil.rows(nodes))
    moment = jnp.stack(moments, axis=2) * grid.spacing
    return value, moment - value[:, :, None] * stencil.away[:, None]


def g2p_through(
    grid: Grid,
    x: Points,
    nodes: Nodes,
    function: Callable[[Columns, list[Array]], Columns],
    forward_mode: bool = False,
) -> tuple[Float[Array, "particle found"], Float[Array, "particle found axis"]]:
    """`g2p_plain` of a function of each node, worked out around the particles alone.

    The function gets the channels of the nodes, each (1, node), and, of each axis, their indices.
    It costs less than at all nodes where these are more than the particles' stencils.
    `forward_mode`: as in `Background`.
    """
    stencil = _Stencil(grid, x)
    columns = (_around_plain if forward_mode else _around)(grid, stencil.first, nodes)
    return stencil.means(once(function, columns, stencil.index()))


def _around_plain(grid: Grid, first: Int[Array, " particle"], nodes: Nodes) -> Columns:
    """Of each channel, the nodes around all particles, of one offset after another."""
    where = (jnp.asarray(_offsets(grid), first.dtype)[:, None] + first[None]).reshape(1, -1)
    channels = range(nodes.shape[1])
    return [nodes.at[where, channel].get(mode="promise_in_bounds") for channel in channels]


@jax.custom_vjp
def _around(grid: Grid, first: Int[Array, " particle"], nodes: Nodes) -> Columns:
    """`_around_plain` with a reverse mode that adds whole nodes into one field."""
    return _around_plain(grid, first, nodes)


def _around_reverse(saved, columns):
    grid, first = saved
    offsets = _offsets(grid)
    rows = _kept(jnp.concatenate(columns).reshape(len(columns), len(offsets), -1))
    nodes = jnp.zeros((math.prod(grid.shape), len(columns)), rows.dtype)
    for i, offset in enumerate(offsets):
        nodes = nodes.at[first + offset].add(rows[:, i].T, mode="promise_in_bounds")
    return _no_slope(grid), np.zeros(first.shape, jax.dtypes.float0), nodes


def _pairing_slope(grid: Grid, x: Points, values: Values, slopes: Slopes, nodes: Nodes) -> Points:
    """The derivative in x of sum_ip w_ip (value_p + slope_p d_ip) . node_i."""
    stencil = _Stencil(grid, x)
    rows = stencil.rows(nodes)
    pairs = zip(_affine_axis(*stencil.affine(values, slopes)), rows, strict=True)
    products = [jnp.sum(affine * row, axis=1, keepdims=True) for affine, row in pairs]
    _, *gradients = _slope_axis(stencil.weights, stencil.rates, products)
    value, *_ = _g2p_axis(stencil.weights, rows)
    return jnp.concatenate(gradients, axis=1) - jnp.sum(value[:, :, None] * slopes, axis=1)


@jax.custom_vjp
def p2g(grid: Grid, x: Points, values: Values, slopes: Slopes) -> Nodes:
    """`p2g_plain` with a faster reverse mode and no forward mode; constant in the grid."""
    return _forward(p2g_plain, grid, x, values, slopes)[0]


@jax.custom_vjp
def g2p(grid: Grid, x: Points, nodes: Nodes) -> tuple[Values, Slopes]:
    """`g2p_plain` with a faster reverse mode and no forward mode; constant in the grid."""
    return _forward(g2p_plain, grid, x, nodes)[0]


def _forward(plain, grid, *inputs):
    inputs = _kept(inputs)
    return _kept(plain(grid, *inputs)), (grid, *inputs)


def _p2g_reverse(saved, nodes):
    grid, x, values, slopes = saved
    nodes = _kept(nodes)
    slope = _pairing_slope(grid, x, values, slopes, nodes)
    return _no_slope(grid), *_kept((slope, *g2p_plain(grid, x, nodes)))


def _g2p_reverse(saved, parts):
    grid, x, nodes = saved
    values, slopes = _kept(parts)
    slope = _pairing_slope(grid, x, values, slopes, nodes)
    return _no_slope(grid), *_kept((slope, p2g_plain(grid, x, values, slopes)))


def _kept(values):
    """Values that XLA computes once and stores, and not anew for each of their many uses."""
    return jax.lax.optimization_barrier(values)


def _no_slope(grid: Grid) -> Grid:
    return jax.tree.map(jnp.zeros_like, grid)


_around.defvjp(lambda *inputs: (_around_plain(*inputs), inputs[:2]), _around_reverse)
p2g.defvjp(partial(_forward, p2g_plain), _p2g_reverse)
g2p.defvjp(partial(_forward, g2p_plain), _g2p_reverse)


class _Stencil:
    """The nodes that each particle touches: three along each axis.

    - `first`: index of the first of them. `corner`: its index along each axis.
    - `away`: vector from that node to the particle, [m].
    - `weights`, `rates`: weights of the three nodes along each axis, [-], and derivatives, [1/m].
    """

    def __init__(self, grid: Grid, x: Points):
        place = (x - grid.lower[None]) / grid.spacing
        last = jnp.asarray(grid.shape, int)[None] - 3
        # clipped, so that a particle that left or is NaN reaches no memory beyond the grid
        first = jnp.clip(jnp.floor(place - 0.5).astype(int), 0, last)
        place = place - first.astype(place.dtype)
        strides = jnp.asarray(_strides(grid), int)[None]
        self.first = jnp.sum(first * strides, axis=1)
        self.corner = list(first.T)
        self.away, self.spacing = place * grid.spacing, grid.spacing
        axes = range(x.shape[1])
        splines = (1.5 - place) ** 2 / 2, 0.75 - (place - 1) ** 2, (place - 0.5) ** 2 / 2
        slopes = place - 1.5, 2 - 2 * place, place - 0.5
        self.weights = [[spline[:, i, None] for spline in splines] for i in axes]
        self.rates = [[slope[:, i, None] / grid.spacing for slope in slopes] for i in axes]
        self._offsets = _offsets(grid)

    def rows(self, nodes: Nodes) -> list[Values]:
        """The field at each of the nodes."""
        places = [self.first + offset for offset in self._offsets]
        return [nodes.at[place].get(mode="promise_in_bounds") for place in places]

    def index(self) -> list[Int[Array, "1 node"]]:
        """Of each axis, the indices of all rows one after another."""
        steps = np.array(list(itertools.product(range(3), repeat=len(self.corner)))).T
        pairs = zip(steps, self.corner, strict=True)
        return [(jnp.asarray(s[:, None], int) + first[None]).reshape(1, -1) for s, first in pairs]

    def means(self, columns: Columns) -> tuple[Values, Slopes]:
        """Weighted means and first moments of a field's rows, of one offset after another."""
        weights = [[weight[:, 0] for weight in axis] for axis in self.weights]
        of_channels = []
        for column in columns:
            # `split`, whose reverse is one array: that of slices is one of each
            rows = jnp.split(column.reshape(-1, len(self.first)), len(self._offsets))
            of_channels.append(_g2p_axis(weights, [row[0] for row in rows]))
        value, *moments = (jnp.stack(parts, axis=1) for parts in zip(*of_channels, strict=True))
        moment = jnp.stack(moments, axis=2) * self.spacing
        return value, moment - value[:, :, None] * self.away[:, None]

    def affine(self, values: Values, slopes: Slopes) -> tuple[Values, list[Values]]:
        """The particles' affine fields at their first nodes, and the differences between nodes."""
        start = values - jnp.sum(slopes * self.away[:, None], axis=2)
        return start, [slopes[:, :, i] * self.spacing for i in range(slopes.shape[2])]


def _strides(grid: Grid) -> list[int]:
    return [math.prod(grid.shape[i + 1 :]) for i in range(len(grid.shape))]


def _offsets(grid: Grid) -> list[int]:
    """Index differences from a particle's first node to all of its nodes, the last axis fastest."""
    strides = _strides(grid)
    steps = itertools.product(range(3), repeat=len(strides))
    return [sum(i * stride for i, stride in zip(step, strides, strict=True)) for step in steps]


def _affine_axis(value, steps):
    """An affine field at all nodes, from its value at the first and its steps along the axes."""
    if not steps:
        return [value]
    nodes = value, value + steps[0], value + 2 * steps[0]
    return [part for node in nodes for part in _affine_axis(node, steps[1:])]


def _p2g_axis(weights, value, steps):
    """An affine field at all nodes, as `_affine_axis` gives it, times the nodes' weights."""
    if not weights:
        return [value]
    nodes, parts = (value, value + steps[0], value + 2 * steps[0]), []
    for weight, node in zip(weights[0], nodes, strict=True):
        parts += _p2g_axis(weights[1:], weight * node, [weight * step for step in steps[1:]])
    return parts


def _g2p_axis(weights, rows):
    """The weighted sum of rows, then those of rows times the node's number along each axis."""
    if not weights:
        return rows
    parts = [_g2p_axis(weights[1:], third) for third in _thirds(rows)]
    moment = weights[0][1] * parts[1][0] + 2 * (weights[0][2] * parts[2][0])
    value, *others = (_dot(weights[0], part) for part in zip(*parts, strict=True))
    return [value, moment, *others]


def _slope_axis(weights, rates, rows):
    """The weighted sum of rows, then its derivatives along each axis."""
    if not weights:
        return rows
    parts = [_slope_axis(weights[1:], rates[1:], third) for third in _thirds(rows)]
    slope = _dot(rates[0], [part[0] for part in parts])
    value, *others = (_dot(weights[0], part) for part in zip(*parts, strict=True))
    return [value, slope, *others]


def _thirds(rows):
    count = len(rows) // 3
    return rows[:count], rows[count : 2 * count], rows[2 * count :]


def _dot(weights, parts):
    return weights[0] * parts[0] + weights[1] * parts[1] + weights[2] * parts[2]
