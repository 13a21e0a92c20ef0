"""A sheet of MuJoCo's flex: recordings whose motion no solver of r2s has made.

All of it is MuJoCo's own: a St. Venant-Kirchhoff membrane with hinges on triangles, its contact
with the table and of the sheet with itself, steps of its linearly implicit integrator "discrete",
and its air, which acts on each vertex as on a cube with faces of the vertex's area (its "inertia
box" model: no lift, and as much drag along the sheet as across it). `r2s.scenarios` gives the start
of the sheet, its grippers and their path, and the frames. Needs r2s[mujoco].

The material is that of MuJoCo's reference, XML, `flex`: Todorov, Erez and Tassa, "MuJoCo: a physics
engine for model-based control", IROS 2012.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Float

from r2s._util.extras import require
from r2s._util.units import AIR_DENSITY, GRAVITY
from r2s.materials.fabric import Fabric
from r2s.recordings.recording import Recording
from r2s.scenarios import synthetic
from r2s.scenarios.scenario import Scenario
from r2s.scenarios.standard import Experiment
from r2s.study.recordings import Moved, Shape, SimulatedRecording, number_of

FABRIC = "mujoco_flex"
SCENARIOS = ("lifting", "folding", "fling", "shaking")  # without fans and clamps
OTHERS = (0.25, 0.5, 2.0, 4.0)  # times as stiff: as the membranes of the presets differ
GRIP = 10.0  # [kg], of a pinned vertex: the sheet's pull moves it by less than 1e-7 m in a step
STEP = 1.6e-3  # [s]: longest time step
ELASTICITY = ("young", "poisson", "thickness", "damping")
# of contacts: time constant [s], damping ratio [-], and impedance
CONTACT = 'solref="0.005 1.0" solimp="0.9 0.95 0.001"'
AXES = ("1 0 0", "0 1 0", "0 0 1")


class Material(NamedTuple):
    """A sheet in MuJoCo's terms.

    - `young` [Pa], `poisson` [-], `thickness` [m]: of a solid plate, for stretch and bending.
    - `damping`: Kelvin-Voigt time, [s].
    - `density`: areal, [kg/m^2].
    - `radius`: of its contacts: the middle of the sheet is as high above the table, [m].
    - `friction`: of sliding, [-].
    """

    young: float = 12e3
    poisson: float = 0.3
    thickness: float = 3.2e-3
    damping: float = 0.02
    density: float = 0.2
    radius: float = 1e-3
    friction: float = 0.8


@dataclass(frozen=True)
class MujocoRecording(SimulatedRecording):
    """A recording of a sheet of MuJoCo.

    - `shape`: vertices along warp and weft. `step`: longest time step, [s].

    Every member of its ensemble settles by itself, and has self-contact, as the recording. The
    other fabrics are sheets whose Young's modulus is so many times as large (`OTHERS`).
    """

    settings: ClassVar[tuple[Any, ...]] = (GRIP, OTHERS)

    material: Material = Material()
    shape: tuple[int, int] = (25, 25)
    step: float = STEP

    def __post_init__(self) -> None:
        if self.scenario not in SCENARIOS:
            raise ValueError(f"{FABRIC} has {', '.join(SCENARIOS)}, not {self.scenario}")

    @property
    def compilation_group(self) -> str:
        return f"recordings of MuJoCo {self.scenario}"

    @property
    def small_strain_fabric(self) -> Fabric | None:
        return as_plate(self.material)

    @property
    def others(self) -> Mapping[str, Material]:
        """Sheets of other moduli, by the factor."""
        return {f"{factor:g}": self.stiffer(self.material, factor) for factor in OTHERS}

    def stiffer(self, material: Material, factor: float) -> Material:
        """A material with `factor` times the Young's modulus."""
        return material._replace(young=factor * material.young)

    def simulate(
        self,
        material: Material,
        shape: tuple[int, int],
        experiment: Experiment,
        steps: int = 1,
        start: Shape | None = None,
    ) -> Moved:
        """A motion, `steps` for one; raises as `moved`."""
        scenario = experiment.scenario(shape)
        return Moved(moved(scenario, material, self.step / steps), scenario.scene.mesh)

    def record(self, out: Path) -> Recording:
        """As of the base; raises as `moved`."""
        experiment = self.experiment
        scenario = experiment.scenario(self.shape)
        number = number_of(self.fabric, self.scenario, self.number, self.unseen)
        key = jr.fold_in(jr.key(self.seed), number)
        x = moved(scenario, self.material, self.step)
        self.save_start(out, scenario, x)
        whose = experiment, scenario, self.fabric, self.number, self.sensing
        made = synthetic.seen_of(jnp.asarray(x, float), *whose, key=key)
        info = dataclasses.replace(made.info, source=f"MuJoCo's flex: {made.info.source}")
        return dataclasses.replace(made, info=info)


def as_plate(material: Material) -> Fabric:
    """The fabric of r2s whose membrane and bending are those of a material at small strain.

    A thin isotropic plate (Timoshenko and Woinowsky-Krieger, "Theory of plates and shells", 1959):
    E h / (1 - nu^2) [N/m], and E h^3 / (12 (1 - nu^2)) [N m] with a Poisson's ratio of bending of
    zero, as other fabrics of r2s.
    """
    young, poisson, thickness = material.young, material.poisson, material.thickness
    stiff = young * thickness / (1 - poisson**2)
    return Fabric.make(
        material.density,
        (stiff, poisson * stiff, stiff, (1 - poisson) / 2 * stiff),
        stiff * thickness**2 / 12,
        damping=material.damping,
        friction=material.friction,
        thickness=material.radius,
    )


def mujoco_module() -> Any:
    """The module `mujoco`. Raises `ImportError` that names the extra when it is not installed."""
    return require("mujoco", "mujoco", "a sheet of MuJoCo's flex")


def moved(
    scenario: Scenario, material: Material, step: float = STEP
) -> Float[np.ndarray, "frame vertex 3"]:
    """Positions [m] of the sheet in the frames of a scenario.

    - `scenario`: gives mesh, grippers, table and frames; its elements and solver are not used.
    - `step`: longest time step, [s].

    A sheet that hangs comes to rest before its first frame, braked as in `r2s.scenarios`. Raises
    `ImportError` that names the extra, and `RuntimeError` that says when it diverges.
    """
    mujoco = mujoco_module()
    mujoco.set_mju_user_warning(lambda message: None)  # or it writes a log file where it is run
    substeps = int(np.ceil(scenario.interval / step - 1e-9))
    dt = scenario.interval / substeps
    model = mujoco.MjModel.from_xml_string(_mjcf(scenario, material, dt))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    data = mujoco.MjData(model)
    flat = _flat(scenario)
    data.qpos[:] = (np.asarray(scenario.start, float) - flat).ravel()
    pinned = (3 * np.asarray(scenario.scene.pinned)[:, None] + np.arange(3)).ravel()
    is_free = np.ones(model.nv)
    is_free[pinned] = 0
    brake = 0.0 if scenario.brake is None else float(scenario.brake)
    model.dof_damping[:] = brake * is_free * model.body_mass[model.dof_bodyid]
    frames = scenario.num_frames + scenario.lead_in - 1
    steps = np.arange(frames * substeps + 1) / substeps - scenario.lead_in  # in frames
    times = float(scenario.first_time) + scenario.interval * steps
    knots, path = np.asarray(scenario.path_times, float), np.asarray(scenario.path, float)
    placed = [np.interp(times, knots, along) for along in path.reshape(len(knots), -1).T]
    path = np.stack(placed, axis=1) - flat.ravel()[pinned]
    velocity = np.diff(path, axis=0) / dt
    x = np.empty((scenario.num_frames, *flat.shape))
    for frame in range(frames):
        if frame == scenario.lead_in:
            model.dof_damping[:] = 0
        if frame >= scenario.lead_in:
            x[frame - scenario.lead_in] = flat + data.qpos.reshape(flat.shape)
        for count in range(frame * substeps, (frame + 1) * substeps):
            data.qpos[pinned], data.qvel[pinned] = path[count], velocity[count]
            mujoco.mj_step(model, data)
        if not (np.isfinite(data.qpos).all() and np.abs(data.qpos).max() < 10):
            when = (frame - scenario.lead_in) * scenario.interval
            raise RuntimeError(
                f"MuJoCo's sheet diverged after {when:g} s: try steps below {dt:.2g} s"
            )
    x[-1] = flat + data.qpos.reshape(flat.shape)
    return x


def _mjcf(scenario: Scenario, material: Material, dt: float) -> str:
    """The model: a body for each vertex, where it is when the sheet is flat and unstretched."""
    mesh, pinned = scenario.scene.mesh, set(np.asarray(scenario.scene.pinned).tolist())
    contact = f'friction="{material.friction} 0.005 0.0001" {CONTACT}'
    elastic = " ".join(f'{name}="{getattr(material, name)}"' for name in ELASTICITY)
    names = " ".join(f"v{i}" for i in range(len(mesh.rest)))
    joints = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in AXES)
    places, areas = _flat(scenario).tolist(), np.asarray(mesh.vertex_area, np.float64).tolist()
    bodies = ""
    for i, (place, area) in enumerate(zip(places, areas, strict=True)):
        mass = GRIP if i in pinned else material.density * area
        inertia = _text([mass * area / 6] * 3)  # of a cube with faces of the vertex's area
        floats = ' gravcomp="1"' if i in pinned else ""
        bodies += f'    <body name="v{i}" pos="{_text(place)}"{floats}>'
        bodies += (
            f'<inertial pos="0 0 0" mass="{mass!r}" diaginertia="{inertia}"/>{joints}</body>\n'
        )
    return f"""<mujoco>
  <option timestep="{dt!r}" gravity="0 0 -{GRAVITY}" density="{AIR_DENSITY}"
      integrator="discrete" solver="CG" cone="elliptic"/>
  <size memory="1G"/>
  <worldbody>
    <geom type="plane" size="0 0 1" pos="0 0 {float(scenario.scene.table.height)}" {contact}/>
{bodies}  </worldbody>
  <deformable>
    <flex name="sheet" dim="2" radius="{material.radius}" body="{names}"
        element="{_text(np.asarray(mesh.faces).ravel().tolist())}">
      <contact selfcollide="auto" {contact}/>
      <elasticity {elastic} elastic2d="both"/>
    </flex>
  </deformable>
</mujoco>
"""


def _flat(scenario: Scenario) -> Float[np.ndarray, "vertex 3"]:
    """Places [m] of the vertices in the plane of the start, which is bowed where it hangs."""
    rest = np.asarray(scenario.scene.mesh.rest, np.float64)
    start = np.asarray(scenario.start, np.float64)
    corners = np.argmin(rest @ [1, 1]), np.argmax(rest @ [1, -1]), np.argmax(rest @ [-1, 1])
    origin, warp, weft = start[list(corners)]
    size = rest.max(axis=0)
    return origin + rest / size @ np.stack([warp - origin, weft - origin])


def _text(numbers: Sequence[float] | Sequence[int]) -> str:
    return " ".join(map(repr, numbers))
