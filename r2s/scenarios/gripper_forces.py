"""What grippers feel: the forces with which they hold a sheet, of any solver."""

from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from r2s.cloth.cloth import Cloth, ClothState
from r2s.cloth.explicit import ExplicitCloth
from r2s.cloth.potential import residual
from r2s.fabrics.fabric import Fabric
from r2s.mpm.sheet import Sheet
from r2s.scenarios.scenario import Braked
from r2s.world.scene import Control

Forces = Float[Array, "handle 3"]


def step_with_forces(
    solver: Any, fabric: Fabric, state: Any, control: Control
) -> tuple[Any, Forces]:
    """`solver.step`, and the mean forces [N] of the grippers on the held vertices in that step.

    For the cloth they are the derivative of the step's potential in the place of the held vertices,
    which vanishes for free ones; self-contact is left out. In explicit steps and for
    material points they are the momentum that the grippers give, over the step. All have the weight
    and the inertia of the held vertices in them. Raises `TypeError` for another solver.
    """
    if isinstance(solver, Braked):
        fabric = solver.braked(fabric, state)
        inner, forces = step_with_forces(solver.solver, fabric, state.inner, control)
        return eqx.tree_at(lambda s: (s.inner, s.count), state, (inner, state.count + 1)), forces
    if isinstance(solver, Cloth):
        after = solver.step(fabric, state, control)
        return after, _cloth_forces(solver, fabric, state, control, after)
    if isinstance(solver, ExplicitCloth | Sheet):
        return solver.step_with_forces(fabric, state, control)
    raise TypeError(
        f"forces are known of Cloth, ExplicitCloth and Sheet, got {type(solver).__name__}"
    )


def _cloth_forces(
    solver: Cloth, fabric: Fabric, state: ClothState, control: Control, after: ClothState
) -> Forces:
    return residual(solver.potential(fabric, state, control), after.x)[solver.scene.held]
