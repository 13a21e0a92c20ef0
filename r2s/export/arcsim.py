"""A fabric as a material file of ARCSim or DiffSim: orthotropic, so that its directions stay."""

from pathlib import Path

from r2s.export import stiffness
from r2s.export.stiffness import Loss
from r2s.materials.arcsim import write_material
from r2s.materials.fabric import Fabric

ELSEWHERE = "damping, friction and thickness: ARCSim and DiffSim keep them in their scene files"
TWICE = "DiffSim uses the numbers twice as stiff: the file has half of them"
HINGES = "bending by hinges: without a plate's Poisson's ratio, and too stiff across diagonals"


def write(path: Path | str, fabric: Fabric, name: str = "", *, diffsim: bool = False) -> Loss:
    """Write a fabric with `r2s.materials.arcsim.write_material`, whose errors it raises; what is
    lost.

    Membrane and bending stiffness along the yarns are exact.
    """
    write_material(path, fabric, name, diffsim=diffsim)
    lost = (ELSEWHERE,)
    lost += (HINGES,) if fabric.bending.element != "hinges" else ()
    lost += (TWICE,) if diffsim else ()
    own = stiffness.probes(stiffness.membrane_stiffness(fabric))
    bending = stiffness.bending_stiffness(fabric)
    return Loss(
        stiffness.relative_errors(own, own), stiffness.relative_errors(bending, bending), lost
    )
