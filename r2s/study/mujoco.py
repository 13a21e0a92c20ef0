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
from collections.abc import Sequence
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
from r2s.metrics.losses import POINTS
from r2s.recordings.recording import save
from r2s.scenarios import synthetic
from r2s.scenarios.scenario import Scenario
from r2s.scenarios.standard import Experiment
from r2s.study.ensembles import (
    COARSER,
    FINER,
    PATH,
    STIFFNESS,
    Moved,
    member_distances,
    recorded_distances,
    save_ensemble,
)
from r2s.study.recordings import RECORDING, START, SimulatedRecording, number_of
from r2s.study.tasks import Task

FABRIC = "mujoco_flex"
SCENARIOS = ("lifting", "folding", "fling", "shaking")  # without fans and clamps
OTHERS = (0.25, 0.5, 2.0, 4.0)  # times as stiff: as the membranes of the presets differ
GRIP = 10.0  # [kg], of a pinned vertex: the sheet's pull moves it by less than 1e-7 m in a step
STEP = 1.6e-3  # [s]: longest time step
ELASTICITY = ("young", "poisson", "thickness", "damping")
AXES = ("1 0 0", "0 1 0", "0 0 1")


class Material(NamedTuple):
    """A sheet in MuJoCo's terms.

    - `young` [Pa], `poisson` [-], `thickness` [m]: of a solid plate, for stretch and bending.
    - `damping`: Kelvin-Voigt time, [s].
    - `density`: areal, [kg/m^2].
    - `radius`: of its contacts: the middle of the sheet is as high above the table, [m].
    - `friction`: of sliding, [-].
    - `solref`, `solimp`: of contacts: time constant [s], damping ratio [-], and impedance.
    - `air`: density of the medium, [kg/m^3].
    """

    young: float = 12e3
    poisson: float = 0.3
    thickness: float = 3.2e-3
    damping: float = 0.02
    density: float = 0.2
    radius: float = 1e-3
    friction: float = 0.8
    solref: tuple[float, float] = (0.005, 1.0)
    solimp: tuple[float, float, float] = (0.9, 0.95, 0.001)
    air: float = AIR_DENSITY


class Resolution(NamedTuple):
    """- `shape`: vertices along warp and weft. - `step`: longest time step, [s]."""

    shape: tuple[int, int] = (25, 25)
    step: float = STEP


@dataclass(frozen=True)
class MujocoRecording(SimulatedRecording):
    """A recording of a sheet of MuJoCo; fields as in `SyntheticRecording`."""

    settings: ClassVar[tuple[Any, ...]] = (GRIP,)

    scenario: str
    number: int = 0
    unseen: bool = False
    seed: int = 0
    material: Material = Material()
    resolution: Resolution = Resolution()
    fabric: str = FABRIC

    def __post_init__(self) -> None:
        if self.scenario not in SCENARIOS:
            raise ValueError(f"{FABRIC} has {', '.join(SCENARIOS)}, not {self.scenario}")

    @property
    def name(self) -> str:
        return f"{self.scenario}_{self.fabric}_{'u' * self.unseen}{self.number}"

    @property
    def compilation_group(self) -> str:
        return f"recordings of MuJoCo {self.scenario}"

    @property
    def small_strain_fabric(self) -> Fabric | None:
        return as_plate(self.material)

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        """Simulate the recording; raises as `moved`."""
        experiment = self.experiment
        scenario = experiment.scenario(self.resolution.shape)
        number = number_of(self.fabric, self.scenario, self.number, self.unseen)
        key = jr.fold_in(jr.key(self.seed), number)
        x = moved(scenario, self.material, self.resolution.step)
        if self.unseen and scenario.brake is not None:
            np.save(out / START, x[0].reshape(*self.resolution.shape, 3))
        made = synthetic.seen_of(
            jnp.asarray(x, float),
            experiment,
            scenario,
            self.fabric,
            self.number,
            self.sensing,
            key=key,
        )
        source = f"MuJoCo's flex: {made.info.source}"
        info = dataclasses.replace(made.info, name=self.name, source=source)
        save(dataclasses.replace(made, info=info), out / RECORDING)
        return {"seed": self.seed, "frames": len(made.times)}


@dataclass(frozen=True)
class MujocoEnsemble(Task):
    """The ensemble of a recording of MuJoCo's sheet, as `r2s.study.ensembles.EnsembleTask`.

    Every member is MuJoCo's, settles by itself, and has self-contact, as the recording. The other
    fabrics are sheets whose Young's modulus is so many times as large.
    """

    kind: ClassVar[str] = "ensembles"
    settings: ClassVar[tuple[Any, ...]] = (STIFFNESS, PATH, FINER, COARSER, POINTS)
    lacks_layers: ClassVar[bool] = False

    recording: MujocoRecording
    others: tuple[float, ...] = OTHERS

    @property
    def name(self) -> str:
        return self.recording.name

    @property
    def compilation_group(self) -> str:
        return f"ensembles of MuJoCo {self.recording.scenario}"

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        """Distances [m] of every member from the truth in each frame.

        Raises as `moved`, also where a member diverges.
        """
        source = self.recording
        experiment, material, (shape, step) = source.experiment, source.material, source.resolution

        def simulate(
            material: Material, shape: tuple[int, int], experiment: Experiment, steps: int = 1
        ) -> Moved:
            scenario = experiment.scenario(shape)
            return Moved(moved(scenario, material, step / steps), scenario.scene.mesh)

        def stiffer(material: Material, factor: float) -> Material:
            return material._replace(young=factor * material.young)

        base = simulate(material, shape, experiment)
        others = {f"{factor:g}": stiffer(material, factor) for factor in self.others}
        found = member_distances(base, material, shape, experiment, simulate, stiffer, others)
        found["recording"] = [recorded_distances(source, folder, base)]
        return save_ensemble(out, experiment, found)


def as_plate(material: Material) -> Fabric:
    """The fabric of r2s whose membrane and bending are those of a material at small strain.

    A thin isotropic plate (Timoshenko and Woinowsky-Krieger, "Theory of plates and shells", 1959):
    E h / (1 - nu^2) [N/m], and E h^3 / (12 (1 - nu^2)) [N m] with a Poisson's ratio of bending of
    zero, as other fabrics of r2s: alike where a sheet bends one way. Hinges on triangles, air and
    contact are not the fabric's, so it moves as the sheet does only in part.
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

    Held vertices go along the path to rounding. A sheet that hangs comes to rest before its first
    frame, braked as in `r2s.scenarios`. The same arguments give the same numbers on one machine.
    Raises `ImportError` that names the extra, and `RuntimeError` that says when it diverges.
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
    path = _path(scenario, np.arange(frames * substeps + 1) / substeps - scenario.lead_in)
    path = path.reshape(len(path), -1) - flat.ravel()[pinned]
    velocity = np.diff(path, axis=0) / dt
    found = np.empty((scenario.num_frames, *flat.shape))
    for frame in range(frames):
        if frame == scenario.lead_in:
            model.dof_damping[:] = 0
        if frame >= scenario.lead_in:
            found[frame - scenario.lead_in] = flat + data.qpos.reshape(flat.shape)
        for count in range(frame * substeps, (frame + 1) * substeps):
            data.qpos[pinned], data.qvel[pinned] = path[count], velocity[count]
            mujoco.mj_step(model, data)
        if not (np.isfinite(data.qpos).all() and np.abs(data.qpos).max() < 10):
            when = (frame - scenario.lead_in) * scenario.interval
            raise RuntimeError(
                f"MuJoCo's sheet diverged after {when:g} s: try steps below {dt:.2g} s"
            )
    found[-1] = flat + data.qpos.reshape(flat.shape)
    return found


def _path(scenario: Scenario, frames: Float[np.ndarray, " step"]) -> np.ndarray:
    """Places [m] of the pinned vertices (step, vertex, 3) at times counted in frames."""
    times = float(scenario.first_time) + scenario.interval * frames
    knots, path = np.asarray(scenario.path_times, float), np.asarray(scenario.path, float)
    placed = [np.interp(times, knots, along) for along in path.reshape(len(knots), -1).T]
    return np.stack(placed, axis=1).reshape(-1, *path.shape[1:])


def _mjcf(scenario: Scenario, material: Material, dt: float) -> str:
    """The model: a body for each vertex, where it is when the sheet is flat and unstretched."""
    mesh, pinned = scenario.scene.mesh, set(np.asarray(scenario.scene.pinned).tolist())
    contact = f'friction="{material.friction} 0.005 0.0001" solref="{_text(material.solref)}"'
    contact += f' solimp="{_text(material.solimp)}"'
    elastic = " ".join(f'{name}="{getattr(material, name)}"' for name in ELASTICITY)
    names = " ".join(f"v{i}" for i in range(len(mesh.rest)))
    areas = np.asarray(mesh.vertex_area, np.float64)
    places = _flat(scenario)
    bodies = "\n".join(
        _body(i, place, area, material, i in pinned)
        for i, (place, area) in enumerate(zip(places, areas.tolist(), strict=True))
    )
    return f"""<mujoco>
  <option timestep="{dt!r}" gravity="0 0 -{GRAVITY}" density="{material.air}"
      integrator="discrete" solver="CG" cone="elliptic"/>
  <size memory="1G"/>
  <worldbody>
    <geom type="plane" size="0 0 1" pos="0 0 {float(scenario.scene.table.height)}" {contact}/>
{bodies}
  </worldbody>
  <deformable>
    <flex name="sheet" dim="2" radius="{material.radius}" body="{names}"
        element="{_text(np.asarray(mesh.faces).ravel().tolist())}">
      <contact selfcollide="auto" {contact}/>
      <elasticity {elastic} elastic2d="both"/>
    </flex>
  </deformable>
</mujoco>
"""


def _body(i: int, place: np.ndarray, area: float, material: Material, is_pinned: bool) -> str:
    """A vertex: a cube with faces of its `area` [m^2] to the air, which does not turn."""
    mass = GRIP if is_pinned else material.density * area
    joints = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in AXES)
    inertia = _text([mass * area / 6] * 3)
    inertial = f'<inertial pos="0 0 0" mass="{mass!r}" diaginertia="{inertia}"/>'
    floats = ' gravcomp="1"' if is_pinned else ""
    return f'    <body name="v{i}" pos="{_text(place.tolist())}"{floats}>{inertial}{joints}</body>'


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
