"""The cloths that are compared, and what to run each with."""

import importlib
import math
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import measure

EVERY_FRAME = 0.0  # rate of implicit systems: their steps do not depend on the mesh


class System(NamedTuple):
    """A cloth, and what to run it with in the scene "hang".

    - `module`: has the functions `forward` and, if not None, `gradient`, as `ours`.
    - `install`: what it needs, for pip.
    - `damping`: time [s], times the cells a side; None: that of the command.
    - `rate`: steps in a second, by the cells a side; `EVERY_FRAME`: one step a frame of 1/60 s.
    - `factors`: by which that is multiplied, the fewest steps first.
    - `finest`: likewise, for its reference.
    """

    name: str
    module: str
    install: str
    forward: str
    gradient: str | None
    damping: float | None
    rate: float
    factors: tuple[int, ...]
    finest: int


# a tenth of the longest explicit step on one cell; more would shorten the steps
LIGHT = 6e-4  # [s]
MUJOCO = ("peer_mujoco", "'mujoco>=3.13'")
NEWTON = ("peer_newton", "'newton>=1.8' 'warp-lang>=1.19'")
EXPLICIT = "forward_explicit"
DIFFERENTIABLE = "forward", "gradient"
ALPHA, TRIANGLES = ((f"forward_{how}", f"gradient_{how}") for how in ("alpha", "triangles"))
SYSTEMS = [
    System("r2s", "ours", "r2s", *DIFFERENTIABLE, None, EVERY_FRAME, (1, 2, 4, 8), 32),
    System("r2s, generalised alpha", "ours", "r2s", *ALPHA, None, EVERY_FRAME, (1, 2, 4), 32),
    System("r2s, triangles", "ours", "r2s", *TRIANGLES, None, EVERY_FRAME, (2, 4), 32),
    System("r2s explicit", "ours", "r2s", EXPLICIT, None, None, EVERY_FRAME, (1,), 4),
    System("mass-spring (JAX)", "peer_springs", "r2s", *DIFFERENTIABLE, LIGHT, 150, (1, 2), 16),
    System("Newton explicit", *NEWTON, EXPLICIT, "gradient", 0.0, 180, (1, 2), 16),
    System("Newton explicit, damped", *NEWTON, EXPLICIT, "gradient", LIGHT, 180, (1, 2), 16),
    System("Newton VBD", *NEWTON, "forward_vbd", None, None, EVERY_FRAME, (10, 20, 40), 160),
    System("MuJoCo", *MUJOCO, "forward_implicit", None, None, EVERY_FRAME, (4, 16, 64), 256),
    System("MuJoCo explicit", *MUJOCO, EXPLICIT, None, 0.0, 180, (1, 2), 16),
]


def available(pattern: str) -> list[System]:
    """The systems whose name matches; says which are not installed."""
    found, missing = [], {}
    for system in SYSTEMS:
        if not re.search(pattern, system.name):
            continue
        try:
            importlib.import_module(system.module)
            found.append(system)
        except ModuleNotFoundError as error:
            if error.name not in ("mujoco", "newton", "warp"):
                raise
            missing.setdefault(system.install, []).append(system.name)
    for install, names in missing.items():
        print(f"skipped: {', '.join(names)} (not installed; pip install {install})")
    return found


def substeps(system: System, size: int, factor: int) -> int:
    """How many steps a frame of 1/60 s; even for explicit systems."""
    if system.rate == EVERY_FRAME:
        return factor
    return 2 * math.ceil(system.rate * (size - 1) * factor / 120)


def damping_time(system: System, size: int, damping: float) -> float:
    """Its damping time [s], when that of the command is `damping`."""
    return damping if system.damping is None else system.damping / (size - 1)


def call_of(
    system: System, kind: str, size: int, factor: int, damping: float
) -> tuple[Callable[..., Any], float]:
    """Its "forward" or "gradient" function, set up and compiled, and the seconds for that."""
    function = getattr(importlib.import_module(system.module), getattr(system, kind))
    setting = size, substeps(system, size, factor), damping_time(system, size, damping)
    return measure.built(lambda: function(*setting))
