"""Material files of ARCSim and DiffSim: the tables of Wang, O'Brien and Ramamoorthi 2011 as JSON.

Such a file has an areal density and the tables of `r2s.materials.tables`, as published. Damping,
friction and thickness are elsewhere in ARCSim and DiffSim.
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from r2s._util.files import parse, read_json, write_json
from r2s.materials.bending import HingeBending
from r2s.materials.fabric import Fabric, check_density, check_fabric
from r2s.materials.membrane import OrthotropicMembrane
from r2s.materials.plate import OrthotropicPlate, PlateBending
from r2s.materials.tables import HINGE_FACTOR, TableBending, TableMembrane

Four = tuple[float, float, float, float]
Five = tuple[float, float, float, float, float]


@dataclasses.dataclass(frozen=True)
class Material:
    """What a material file holds. Raises `ValueError` for numbers that no fabric has."""

    density: float = dataclasses.field(metadata={"unknown": "it is the areal density [kg/m^2]"})
    stretching: tuple[Four, Four, Four, Four, Four, Four] = dataclasses.field(
        metadata={"unknown": "it is 6 rows of C11, C12, C22, C33 [N/m]"}
    )
    bending: tuple[Five, Five, Five] = dataclasses.field(
        metadata={"unknown": "it is 3 rows (directions) of 5 (curvatures) stiffnesses [N m]"}
    )
    name: str = ""

    def __post_init__(self):
        if not self.density > 0:
            raise ValueError(f"density must be above 0 kg/m^2, got {self.density}")
        check_density(self.density)
        # measured C12 and C33 may be negative
        for row, (c11, _, c22, _) in enumerate(self.stretching):
            if not min(c11, c22) > 0:
                raise ValueError(
                    f"stretching[{row}]: C11 and C22 must be above 0 N/m, got {c11} and {c22}"
                )
        for row, stiffnesses in enumerate(self.bending):
            if not min(stiffnesses) >= 0:
                raise ValueError(
                    f"bending[{row}]: stiffness must not be below 0 N m, got {min(stiffnesses)}"
                )


def read_material(
    path: Path | str,
    *,
    damping: float = 0.01,
    friction: float = 0.5,
    thickness: float = 1e-3,
    mass_damping: float = 0.0,
) -> Fabric:
    """The fabric of a material file, whose stiffness follows the strain and the curvature.

    The arguments are what the file does not hold: damping time [s], friction [-], thickness [m],
    mass damping [1/s]. Raises `OSError`; `ValueError` that names the file, the key and what was
    expected there, or one of the arguments.
    """
    material = read_json(path, Material, comments=True)
    others = (damping, friction, thickness, mass_damping)
    fabric = Fabric(
        jnp.asarray(material.density, float),
        TableMembrane(jnp.asarray(material.stretching, float)),
        TableBending(jnp.asarray(material.bending, float)),
        *(jnp.asarray(number, float) for number in others),
    )
    check_fabric(fabric)
    return fabric


def write_material(
    path: Path | str, fabric: Fabric, name: str = "", *, diffsim: bool = False
) -> None:
    """Write a fabric as a material file, whole or not at all; `name` is a label in it.

    Tables are written as they are, a constant stiffness as a table of equal rows; for `diffsim`,
    which doubles membrane stiffnesses, as half of it. A plate is written as hinges, without its
    Poisson's ratio. Damping, friction and thickness are not written.

    Raises `TypeError` for a law that is neither; `ValueError` for a batch of fabrics, for what
    `read_material` would refuse, and for a constant C12 < 0 with `diffsim`, which takes it for 0.
    """
    if jnp.ndim(fabric.density):
        raise ValueError(
            f"a material file holds one fabric, got a batch of shape {jnp.shape(fabric.density)}"
        )
    content = {
        "density": float(fabric.density),
        "stretching": _stretching(fabric.membrane, diffsim).tolist(),
        "bending": _bending(fabric.bending).tolist(),
        "name": name,
    }
    parse(Material, content, f"cannot write {path}")
    write_json(path, content)


def _stretching(law: Any, diffsim: bool) -> np.ndarray:
    if isinstance(law, TableMembrane):
        return np.asarray(law.stiffness)
    if not isinstance(law, OrthotropicMembrane):
        raise TypeError(
            "a material file holds a TableMembrane or an OrthotropicMembrane, got "
            f"{type(law).__name__}"
        )
    published = np.array([law.c11, law.c12, law.c22, 2 * law.c33])  # C33 acts on E12 there
    if diffsim and published[1] < 0:
        raise ValueError(f"DiffSim takes a negative C12 for 0, got {published[1]} N/m")
    return np.tile(published / 2 if diffsim else published, (6, 1))


def _bending(law: Any) -> np.ndarray:
    if isinstance(law, TableBending):
        return np.asarray(law.stiffness)
    if isinstance(law, HingeBending | PlateBending):
        return np.full((3, 5), HINGE_FACTOR * np.asarray(law.stiffness))
    if not isinstance(law, OrthotropicPlate):
        raise TypeError(
            "a material file holds a TableBending, or the constant stiffness of hinges or of a "
            f"plate, got {type(law).__name__}"
        )
    # an edge along the warp bends the weft
    by_edge = HINGE_FACTOR * np.array([law.weft, law.bias, law.warp])
    return np.tile(by_edge[:, None], (1, 5))
