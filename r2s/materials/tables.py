"""Laws from tables of measured stiffness, which depends on the strain or the curvature.

Wang, O'Brien and Ramamoorthi ("Data-driven elastic models for cloth: modeling and measurement", ACM
Transactions on Graphics 30(4), 2011) measured fabrics as such tables; ARCSim and DiffSim use them,
and `r2s.materials.arcsim` reads their files.

The tables are secant stiffness: stress = C(E) E, bending moment = B(kappa) kappa. Such a stress
derives from no energy: a time step uses the law of constant stiffness at its start, from `at`.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.materials.bending import HingeBending, HingeLaw
from r2s.materials.membrane import OrthotropicMembrane

LARGE_STRETCH = 1 / 6  # [-]: the extension at which the large-strain rows were measured
CURVATURE_STEP = 10.0  # [1/m]: between the columns of a bending table
BLUR = 1e-3  # [-]: principal strains that differ by less hardly have a direction
HINGE_FACTOR = 4.0  # published bending stiffness over bending stiffness of the hinge


class TableMembrane(eqx.Module):
    """Membrane whose stiffness depends on the principal stretch and its direction.

    - `stiffness`: as published, C11, C12, C22, C33 [N/m] in each row. Row 0 is at zero strain, rows
      1 to 5 at a principal extension of 16.7 % along 0, 22.5, 45, 67.5 and 90 degrees from the
      warp. The published C33 acts on the shear strain E12: it is twice the `c33` of
      `OrthotropicMembrane`.
    """

    stiffness: Float[Array, "*batch 6 4"]

    def at(self, strain: Float[Array, " 3"]) -> OrthotropicMembrane:
        """The constant stiffness that the law has at a strain (E11, E22, 2 E12) [-].

        Linear in the largest principal stretch and, between the large-strain rows, in its
        direction; constant in compression and beyond the table; of an isotropic stretch the row of
        45 degrees. A negative C33 is raised to zero, C12 limited to what C11 and C22 allow.
        """
        stretch, angle = _principal(strain)
        weight = jnp.clip((stretch - 1) / LARGE_STRETCH, 0, 1)
        small, large = self.stiffness[0], _between(self.stiffness[1:], 8 * angle / jnp.pi)
        published = small + weight * (large - small)
        least = jnp.array([0, -jnp.inf, 0, 0], published.dtype)
        c11, c12, c22, c33 = jnp.maximum(published, least)
        bound = jnp.sqrt(jnp.maximum(c11 * c22, jnp.finfo(published.dtype).tiny))
        return OrthotropicMembrane(c11, jnp.clip(c12, -bound, bound), c22, c33 / 2)

    def energy_density(self, strain: Float[Array, " 3"]) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a Green strain (E11, E22, 2 E12) [-], of the stiffness
        there. Its gradient is not the stress, which is that of the energy of `at(strain)`.
        """
        return self.at(strain).energy_density(strain)


class TableBending(HingeLaw):
    """Bending whose stiffness depends on the direction and the curvature.

    - `stiffness`: as published [N m]. Rows are the directions 0, 45 and 90 degrees of an edge from
      the warp; columns the curvatures theta l / A of 0, 10, 20, 30 and 40 1/m at the edge.

    The published stiffness k is that of the force k l^2 / (4 A) theta dtheta/dx of an edge of
    length l, A the areas of its two triangles; here it is B l^2 / A theta dtheta/dx: B is k / 4.
    """

    stiffness: Float[Array, "*batch 3 5"]

    def at(self, direction: Float[Array, ""], curvature: Float[Array, ""]) -> HingeBending:
        """The constant stiffness of a hinge at a curvature [1/m], linear between the entries.

        `direction` is that of the line which the hinge bends [rad], at right angles to its edge.
        """
        row, column = 2 - 4 * direction / jnp.pi, jnp.abs(curvature) / CURVATURE_STEP
        return HingeBending(_between(_between(self.stiffness, row), column) / HINGE_FACTOR)


def _between(table: Float[Array, "row ..."], index: Float[Array, ""]) -> Float[Array, "..."]:
    """Rows of a table, interpolated linearly at an index [-] and constant beyond its ends."""
    last = table.shape[0] - 1
    index = jnp.clip(index, 0, last)
    below = jnp.clip(jnp.floor(index), 0, last - 1)
    low = below.astype(int)
    # in this form equal rows give exactly their numbers
    return table[low] + (index - below) * (table[low + 1] - table[low])


def _principal(strain: Float[Array, " 3"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The largest principal stretch [-], at least 1, and its angle to the warp, 0 to pi/2 [rad].

    Where the principal strains are equal the angle is undefined and the stretch has a kink: both
    are blurred over a difference of `BLUR`, and the angle becomes pi/4 there.
    """
    e11, e22, shear = strain
    difference = e11 - e22
    squared = difference**2 + shear**2  # of the difference between the principal strains
    stretch = jnp.sqrt(jnp.maximum(1 + e11 + e22 + squared / jnp.sqrt(squared + BLUR**2), 1))
    # far below the blur, where the derivative of the arctangent would overflow, any angle does
    has_angle = squared > 1e-12 * BLUR**2
    angle = jnp.arctan2(jnp.abs(shear), jnp.where(has_angle, difference, 1)) / 2
    return stretch, jnp.pi / 4 + squared / (squared + BLUR**2) * (angle - jnp.pi / 4)
