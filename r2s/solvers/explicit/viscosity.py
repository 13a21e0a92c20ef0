"""Viscosity of a membrane in explicit steps.

Kelvin-Voigt damping makes the fastest waves of a membrane stiff: 0.01 s of it need ten to thirty
times as many steps. Here its viscous stress is damping (S - R) / relaxation, with the elastic
stress S and the stress R that follows it within a relaxation time (a Zener, or standard linear,
solid). Changes slower than that time are damped by damping dS/dt, as by Kelvin and Voigt; faster
ones meet a membrane that is 1 + damping / relaxation times as stiff.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

RELAXATION = 2e-3  # [s]: docs/solvers.md says what motions differ by


class Viscosity(NamedTuple):
    """Of substeps of one length, all dimensionless.

    - `share`: viscous stress over what the elastic stress is ahead.
    - `rate`: of that, which is caught up in a substep.
    """

    share: Array
    rate: Array

    @classmethod
    def make(cls, damping: Array, relaxation: Array, dt: Array) -> "Viscosity":
        """From times, [s]. Without relaxation it is Kelvin's and Voigt's, a substep behind."""
        return cls(damping / (relaxation + dt), dt / (relaxation + dt))

    def resist(self, stress: Array, relaxed: Array, begun: Array) -> tuple[Array, Array]:
        """Stress with viscosity, and the relaxed stress after the substep, [N/m].

        Where a motion has not `begun`, nothing has changed so far.
        """
        ahead = jnp.where(begun, stress - relaxed, 0)
        return stress + self.share * ahead, stress + (self.rate - 1) * ahead
