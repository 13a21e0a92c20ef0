"""Wrong arguments of a step are named before JAX meets them."""

from typing import Any

from r2s.environment.scene import Control, Scene
from r2s.materials.fabric import Fabric

LONGEST = 10.0  # [s], of a step, as while a sheet comes to rest: more is hardly meant in seconds


def check_step_arguments(
    scene: Scene, fabric: Any, state: Any, control: Any, kind: type[Any]
) -> None:
    """Raise `TypeError` for arguments in another order, `ValueError` for shapes that do not fit.

    - `kind`: that of the solver's states.
    """
    expected = ("fabric", fabric, Fabric), ("state", state, kind), ("control", control, Control)
    for name, argument, cls in expected:
        if not isinstance(argument, cls):
            raise TypeError(
                f"step(fabric, state, control): {name} must be a {cls.__name__}, got "
                f"{type(argument).__name__}"
            )
    scene.check(state, control)
