"""A fabric as a material file of ARCSim or DiffSim: orthotropic, so that its directions stay."""

from pathlib import Path

from r2s.export import stiffness
from r2s.export.stiffness import Loss
from r2s.materials.arcsim import write_material
from r2s.materials.fabric import Fabric

ELSEWHERE = "damping, friction and thickness: ARCSim and DiffSim keep them in their scene files"
HINGES = "bending by hinges: without a plate's Poisson's ratio, and too stiff across diagonals"


def write(path: Path | str, fabric: Fabric, name: str = "") -> Loss:
    """Write a fabric with `r2s.materials.arcsim.write_material`, whose errors it raises; what is
    lost.

    Membrane and bending stiffness along the yarns are exact.
    """
    write_material(path, fabric, name)
    own = stiffness.probes(stiffness.membrane_stiffness(fabric))
    bending = stiffness.bending_stiffness(fabric)
    lost = (ELSEWHERE,) if fabric.bending.element == "hinges" else (ELSEWHERE, HINGES)
    membrane = stiffness.relative_errors(own, own)
    return Loss(membrane, stiffness.relative_errors(bending, bending), lost)
