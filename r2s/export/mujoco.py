"""A fabric as a flex of MuJoCo (4.0), in MJCF.

MuJoCo's 2-D flex is a solid plate of Young's modulus E [Pa], Poisson's ratio nu in [0, 0.5) and
thickness h [m]: a St. Venant-Kirchhoff membrane in plane stress of stiffness E h, that of r2s on
the same mesh; and hinges of bending stiffness E h^3 / (12 (1 - nu^2)), too stiff across diagonals.
Both stiffnesses fix E and h (`r2s.materials.solid.plate_solid`): h is not the fabric's thickness,
which is the `radius` of its contacts. `damping` is a Kelvin-Voigt time [s], as in r2s.

The model has a body for each vertex, pinned vertices tied to mocap bodies, and springs along the
yarns (spatial tendons) that make it orthotropic.
"""

from typing import Any

import numpy as np

from r2s._util.units import GRAVITY
from r2s.export import stiffness
from r2s.export.stiffness import Loss, Springs
from r2s.materials.fabric import Fabric
from r2s.materials.solid import plate_solid
from r2s.mesh.mesh import Mesh

POISSON = (0.0, 0.499)
RIGID = "mass damping: `r2s.export.mujoco.brake` sets it in the finished model"
AXES = ("1 0 0", "0 1 0", "0 0 1")
LARGE = "at large strains the springs along the yarns are linear in length, not in Green strain"


def mjcf(
    fabric: Fabric,
    mesh: Mesh,
    *,
    pinned: tuple[int, ...] = (),
    height: float = 0.0,
    table: float | None = 0.0,
    yarns: bool = True,
    timestep: float = 5e-4,
) -> tuple[str, Loss]:
    """A whole model, and what is lost: a sheet, horizontal at a `height` [m], over a table.

    - `pinned`: vertices that are tied to mocap bodies, in this order: move `mjData.mocap_pos`.
    - `table`: z of its surface [m]; None: there is none.
    - `yarns`: springs along warp and weft, for a mesh such as `r2s.rectangle`; without, the nearest
      isotropic sheet.
    - `timestep`: of MuJoCo, [s].

    Vertex i is the body "v<i>" and number i of the flex "cloth". Raises `ValueError` for a batch,
    for a membrane without positive stiffness, and with yarns for a mesh that has none.
    """
    if yarns:
        sheet = stiffness.with_springs(fabric, POISSON, negative=False)
        springs = stiffness.yarn_springs(mesh, sheet.warp, sheet.weft)
        tendons = _tendons(springs, float(fabric.damping))
    else:
        sheet, tendons = stiffness.nearest_isotropic(fabric, POISSON), ""
    lost = (LARGE,) if yarns else ()
    lost += (RIGID,) if float(fabric.mass_damping) else ()
    friction = f'friction="{float(fabric.friction)!r} 0.005 0.0001"'
    plane = f'<geom type="plane" size="0 0 1" pos="0 0 {table!r}" {friction}/>'
    names = " ".join(f"v{i}" for i in range(len(mesh.rest)))
    text = f"""<mujoco>
  <option timestep="{timestep!r}" gravity="0 0 {-GRAVITY}" integrator="discrete"/>
  <size memory="1G"/>
  <worldbody>
    {plane if table is not None else ""}
{_bodies(fabric, mesh, pinned, height)}
  </worldbody>
  <deformable>
    <flex name="cloth" dim="2" radius="{float(fabric.thickness)!r}" body="{names}"
        element="{_numbers(np.asarray(mesh.faces))}">
      <contact selfcollide="none" {friction}/>
      <elasticity {_elasticity(fabric, mesh, sheet)}/>
    </flex>
  </deformable>
{tendons}{_grips(pinned, timestep)}</mujoco>
"""
    return text, stiffness.loss_of(fabric, sheet.stiffness, mesh, lost)


def brake(model: Any, fabric: Fabric) -> None:
    """Set the mass damping [1/s] of a model of MuJoCo in which all that moves is this fabric.

    MJCF has no damping of a flex's joints; the engine does.
    """
    mass = np.asarray(model.body_mass)[np.asarray(model.dof_bodyid)]
    model.dof_damping[:] = float(fabric.mass_damping) * mass


def _elasticity(fabric: Fabric, mesh: Mesh, sheet: stiffness.Sheet) -> str:
    """The attributes of `<elasticity>`: membrane, bending and damping."""
    near = stiffness.isotropic(sheet.modulus, sheet.poisson)
    bending, parts = stiffness.hinge_stiffness(fabric, mesh), "both"
    if bending:
        young, _, thickness = map(float, plate_solid(near[0, 0], near[0, 1], bending))
    else:
        thickness, parts = float(fabric.thickness), "stretch"
        young = sheet.modulus / thickness
    return (
        f'young="{young}" poisson="{sheet.poisson}" thickness="{thickness}" '
        f'damping="{float(fabric.damping)}" elastic2d="{parts}"'
    )


def _bodies(fabric: Fabric, mesh: Mesh, pinned: tuple[int, ...], height: float) -> str:
    """A mocap body for each pinned vertex, in their order, and a body for each vertex."""
    mass = float(fabric.density) * np.asarray(mesh.vertex_area, np.float64)
    flat = np.pad(np.asarray(mesh.rest, np.float64), ((0, 0), (0, 1)))
    places = flat + [0.0, 0.0, height]
    lines = [f'    <body name="h{i}" pos="{_numbers(places[i])}" mocap="true"/>' for i in pinned]
    for i in range(len(places)):
        joints = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in AXES)
        tiny = _numbers(np.full(3, 1e-6 * mass[i]))
        inertial = f'<inertial pos="0 0 0" mass="{float(mass[i])!r}" diaginertia="{tiny}"/>'
        opening = f'    <body name="v{i}" pos="{_numbers(places[i])}">'
        lines.append(f'{opening}{inertial}{joints}<site name="v{i}"/></body>')
    return "\n".join(lines)


def _grips(pinned: tuple[int, ...], timestep: float) -> str:
    """What ties pinned vertices to their mocap bodies, as stiff as the time step allows."""
    lines = [
        f'    <connect body1="v{i}" body2="h{i}" anchor="0 0 0" solref="{2 * timestep!r} 1"/>'
        for i in pinned
    ]
    return "  <equality>\n" + "\n".join(lines) + "\n  </equality>\n" if pinned else ""


def _tendons(springs: Springs, damping: float) -> str:
    lines = [
        f'    <spatial stiffness="{k!r}" damping="{damping * k!r}" springlength="{length!r}">'
        f'<site site="v{a}"/><site site="v{b}"/></spatial>'
        for (a, b), k, length in zip(*(part.tolist() for part in springs), strict=True)
        if k > 0
    ]
    return "  <tendon>\n" + "\n".join(lines) + "\n  </tendon>\n" if lines else ""


def _numbers(values: np.ndarray) -> str:
    return " ".join(repr(value) for value in values.ravel().tolist())
