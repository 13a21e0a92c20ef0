"""The recordings that a study estimates from and evaluates on, synthetic or given.

Synthetic recordings do not come from the estimators' own model: except for folds, whose layers
touch, their mesh is finer, their time steps are shorter, and their fabrics stiffen with the strain
and soften with the curvature, as measured ones do.
"""

import dataclasses
import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Float
from scipy.interpolate import RegularGridInterpolator

from r2s.compilation import compile_once
from r2s.estimation.default_spaces import Law
from r2s.estimation.pinn.pulls import pulled
from r2s.materials import presets
from r2s.materials.arcsim import read_material
from r2s.materials.fabric import Fabric, constant_laws
from r2s.materials.stiffening import SofteningPlate, StiffeningMembrane
from r2s.mesh.mesh import Mesh
from r2s.recordings import manifest
from r2s.recordings.recording import Recording, load, save
from r2s.scenarios import synthetic
from r2s.scenarios.paths import draw
from r2s.scenarios.resolution import explicit_cloth
from r2s.scenarios.scenario import Scenario, rollout
from r2s.scenarios.standard import SCENARIOS, STRETCHING_INTERVAL, Experiment
from r2s.solvers.simulate import Solution
from r2s.study.tasks import Task, result_files

RECORDING = "recording.npz"
START = "start.npy"  # the shape of a hanging sheet in its first frame
STRETCH = 1.1  # where half of `TruthSettings.stiffening` is reached; Wang et al. 2011: up to 1.167
SOFTENING, KNEE = 0.35, 20.0  # [-] and [1/m], of a `SofteningPlate`
# Damping [s] and friction [-]. Not measured: one sample for each fabric, in the range of fabrics.
LOSSES = {
    "camel_ponte_roma": (0.016, 0.62),
    "black_denim": (0.006, 0.45),
    "grey_interlock": (0.009, 0.37),
    "pink_solid": (0.004, 0.55),
    "red_jet_set": (0.012, 0.28),
}
PULL_FRAMES = 48  # of a pull for `r2s.estimation.pinn`: the longest ends before the last of them
LAYERED = (17, 17)  # vertices at most of a sheet that touches itself, in implicit steps
SAME_SCENARIO = {"lift": "lifting", "fold": "folding"}  # names in other data sets
# [s] of damped settling, after which another fabric rests near the truth's shape: 1.8 mm from where
# it is after 3 s at most; after 0.4 s 4.6 mm
SETTLING = 0.75

Shape = Float[np.ndarray, "row column 3"]


@dataclass(frozen=True)
class TruthSettings:
    """How synthetic recordings are made.

    - `shape`: vertices along warp and weft; of a sheet that touches itself `LAYERED` at most.
    - `max_step`: longest implicit time step, [s], of a sheet that touches itself or is stretched;
      all others have explicit steps.
    - `stiffening`: stiffness along a yarn at large strain over that at zero strain; half of the
      increase is reached at an extension of 10 %. Bending softens, too
      (`r2s.materials.stiffening`). Assumed, not measured. 0: constant stiffness of both.
    - `materials`, `materials_digest`: a folder with measured tables to use instead, and a hash of
      it, see `with_measured_tables`; "": none.
    """

    shape: tuple[int, int] = (33, 33)
    max_step: float = 1 / 90
    stiffening: float = 2.0
    materials: str = ""
    materials_digest: str = ""


class Moved(NamedTuple):
    """Positions [m] of the vertices of a mesh in the frames of a motion."""

    x: np.ndarray
    mesh: Mesh


@dataclass(frozen=True)
class Source(Task):
    """A recording of a `fabric` in a `scenario`."""

    kind: ClassVar[str] = "recordings"
    is_given: ClassVar[bool] = False  # read, not simulated

    fabric: str
    scenario: str

    @property
    def small_strain_fabric(self) -> Fabric | None:
        """The true fabric at small strain, in the laws of r2s; None where it is not known."""
        return None


@dataclass(frozen=True)
class SimulatedRecording(Source):
    """A recording of a motion of `r2s.scenarios`, by any simulator.

    - `number`: 0 is the scenario's standard motion; others are sampled within
      `r2s.scenarios.paths.LIMITS`, the same for all fabrics.
    - `unseen`: whether it is for evaluation: its motion is none to estimate from, and its clouds
      are the whole surface without noise.

    A subclass simulates its motion, and those of an ensemble (`r2s.study.ensembles`), with a
    `material` in its own terms. Where `keeps_start`, a hanging sheet starts in the truth's shape.
    """

    keeps_start: ClassVar[bool] = False

    number: int = 0
    unseen: bool = False
    seed: int = 0

    @property
    def name(self) -> str:
        return f"{self.scenario}_{self.fabric}_{'u' * self.unseen}{self.number}"

    @property
    def compilation_group(self) -> str:
        return f"recordings {self.scenario}"

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int]:
        """Vertices along warp and weft."""

    @property
    def experiment(self) -> Experiment:
        """The motion, the same for all fabrics."""
        if self.number == 0 and not self.unseen:
            return SCENARIOS[self.scenario]()
        key = jr.fold_in(jr.key(self.seed), number_of(self.scenario))
        (numbers,) = draw(self.scenario, 1, key=jr.fold_in(key, 2 * self.number + self.unseen))
        return SCENARIOS[self.scenario](**numbers)

    @property
    def sensing(self) -> synthetic.Sensing:
        """How cameras observe it."""
        return synthetic.WHOLE if self.unseen else synthetic.sensing(self.experiment)

    @property
    def has_layers(self) -> bool:
        """Whether the sheet touches itself, and the members of its ensemble do not."""
        return False

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        """Simulate the recording."""
        made = self.record(out)
        info = dataclasses.replace(made.info, name=self.name, trial=str(self.number))
        save(dataclasses.replace(made, info=info), out / RECORDING)
        return {"seed": self.seed, "frames": len(made.times)}

    @abstractmethod
    def record(self, out: Path) -> Recording:
        """Simulate the recording, and `save_start`."""

    def save_start(self, out: Path, scenario: Scenario, x: Any) -> None:
        """Write the shape in the first frame of a hanging sheet for evaluation."""
        if self.unseen and scenario.brake is not None:
            np.save(out / START, np.asarray(x[0]).reshape(*self.shape, 3))


@dataclass(frozen=True)
class SyntheticRecording(SimulatedRecording):
    """A synthetic recording of a preset's fabric.

    - `angle`: from the pull of a stretching to the warp [degrees], for `r2s.estimation.pinn`; each
      angle and number has a stretch and a rate of its own. None: a motion of `r2s.scenarios`.
    """

    settings: ClassVar[tuple[Any, ...]] = (
        *(STRETCH, SOFTENING, KNEE, LOSSES, PULL_FRAMES, LAYERED),
    )
    keeps_start: ClassVar[bool] = True

    truth: TruthSettings = TruthSettings()
    angle: float | None = None

    @property
    def name(self) -> str:
        turned = "" if self.angle is None else f"_{self.angle:g}"
        return f"{self.scenario}_{self.fabric}{turned}_{'u' * self.unseen}{self.number}"

    @property
    def has_layers(self) -> bool:
        return self.scenario == "folding"

    @property
    def small_strain_fabric(self) -> Fabric | None:
        return None if self.truth.materials else small_strain(self.fabric)

    @property
    def material(self) -> Fabric:
        return strain_dependent(self.fabric, self.truth)

    @property
    def shape(self) -> tuple[int, int]:
        return self.truth.shape

    @property
    def others(self) -> Mapping[str, Fabric]:
        """The truths of all other presets."""
        names = [name for name in presets.FIVE if name != self.fabric]
        return {name: strain_dependent(name, self.truth) for name in names}

    def simulate(
        self,
        material: Fabric,
        shape: tuple[int, int],
        experiment: Experiment,
        steps: int = 1,
        start: Shape | None = None,
    ) -> Moved:
        """A motion in explicit steps, `steps` for one; NaN from where it diverged."""
        scenario = started(experiment.scenario(shape), start)
        motion = _moved(scenario, material, steps)
        ok = np.logical_and.accumulate(np.asarray(motion.ok))[:, None, None]
        return Moved(np.where(ok, np.asarray(motion.x), np.nan), scenario.scene.mesh)

    def stiffer(self, material: Fabric, factor: float) -> Fabric:
        """A fabric whose membrane and bending energies are `factor` times as large."""

        def where(f: Fabric) -> list:
            membrane = getattr(f.membrane, "small", f.membrane)
            bending = getattr(f.bending, "small", f.bending)
            return [membrane, bending.stiffness]

        parts = [jax.tree.map(lambda leaf: factor * leaf, part) for part in where(material)]
        return eqx.tree_at(where, material, parts)

    def record(self, out: Path) -> Recording:
        key = jr.fold_in(jr.key(self.seed), number_of(self.fabric, self.scenario, self.number))
        if self.angle is not None:
            return pulled(
                self.material,
                self.fabric,
                math.radians(self.angle),
                shape=self.shape,
                frames=PULL_FRAMES,
                steps=math.ceil(STRETCHING_INTERVAL / self.truth.max_step - 1e-9),
                key=jr.fold_in(key, round(self.angle)),
                **pull_of(self.number, self.angle, self.seed),
            )
        motion, experiment = None, self.experiment
        if not self.has_layers and self.scenario != "stretching":
            scenario = experiment.scenario(self.shape)
            motion = _moved(scenario, self.material)
            self.save_start(out, scenario, motion.x)
        return synthetic.record(
            experiment,
            self.material,
            self.fabric,
            seen=self.sensing,
            shape=min(self.shape, LAYERED) if self.has_layers else self.shape,
            max_step=self.truth.max_step,
            self_contact=self.has_layers,
            motion=motion,
            key=key,
        )


@dataclass(frozen=True)
class GivenRecording(Source):
    """A recording in a folder with its manifest; `digest`: a hash of its files."""

    is_given: ClassVar[bool] = True

    trial: str
    folder: str
    recording: str
    digest: str

    @property
    def name(self) -> str:
        return self.recording

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        """Read the recording, and store it as it was read."""
        rules = manifest.manifest_for(self.folder)
        recording = manifest.read_recording(self.folder, rules, self.recording)
        save(recording, out / RECORDING)
        return {"frames": len(recording.times), "verified": recording.info.verified}


_rollout = compile_once(rollout)


def _moved(scenario: Scenario, fabric: Fabric, steps: int = 1) -> Solution:
    solver = explicit_cloth(scenario, fabric)
    solver = dataclasses.replace(solver, substeps=steps * solver.substeps)
    return _rollout(scenario, fabric, solver=solver)


def find_recordings(folder: Path) -> list[GivenRecording]:
    """The recordings in a folder, by its own manifest or that of DIFFCLOUD.

    Raises what `r2s.recordings.manifest` raises, and `ValueError` when there is none.
    """
    rules = manifest.manifest_for(folder)
    recordings = []
    for name in manifest.read_recordings(folder, rules):
        digest = sha256()
        found = manifest.find(folder, rules, name)
        for file in manifest.sources(found):
            digest.update(file.read_bytes())
        info = manifest.read_recording(folder, rules, name, found=found).info
        scenario = SAME_SCENARIO.get(info.scenario, info.scenario)
        place = (info.fabric, scenario, info.trial, str(folder), name)
        recordings.append(GivenRecording(*place, digest.hexdigest()))
    if not recordings:
        raise ValueError(f"{folder}: no recording that a manifest describes")
    return recordings


def read(source: Source, folder: Path) -> Recording:
    """The recording of a finished task."""
    with result_files(source, folder) as files:
        return load(files / RECORDING)


def read_start(source: Source, folder: Path) -> Shape | None:
    """The true shape [m] of a hanging sheet in the first frame of a recording for evaluation.

    None for a sheet that lies on the table, and for given recordings, where it is not known.
    """
    with result_files(source, folder) as files:
        return np.load(files / START) if (files / START).exists() else None


def started(scenario: Scenario, shape: Shape | None) -> Scenario:
    """A scenario whose sheet starts in a shape and settles for `SETTLING` before it moves.

    A sheet that hangs from corners drawn together buckles into one of several shapes, by mesh and
    fabric: from a flat sheet the true fabric on another mesh may begin a centimetre away. The cloud
    of the first frame does not fix that shape; the truth's own does.

    `shape`: positions [m] of a regular grid along warp and weft; None: the scenario is unchanged.
    Raises `ValueError` for a sheet that lies on the table, which starts flat.
    """
    if shape is None:
        return scenario
    if scenario.brake is None:
        raise ValueError("a sheet that lies on the table starts flat, but a shape was given")
    rest = np.asarray(scenario.scene.mesh.rest, np.float64)
    along = tuple(np.linspace(0, 1, count) for count in shape.shape[:2])
    start = RegularGridInterpolator(along, shape)(np.clip(rest / rest.max(axis=0), 0, 1))
    pinned = scenario.path[1]
    return dataclasses.replace(
        scenario,
        start=scenario.scene.place(jnp.asarray(start, float), pinned),
        path=scenario.path.at[0].set(pinned),
        lead_in=math.ceil(SETTLING / scenario.interval),
    )


def pull_of(number: int, angle: float, seed: int) -> dict[str, float]:
    """Stretch and time of a pull at an `angle` [degrees] to the warp, the same for all fabrics;
    sampled for each angle and number within `r2s.scenarios.paths.LIMITS`."""
    key = jr.fold_in(jr.key(seed), number_of("pull", number, float(angle)))
    return draw("stretching", 1, key=key)[0]


def number_of(*parts: Any) -> int:
    """A hash of the parts, below 2^31."""
    return int.from_bytes(sha256(repr(parts).encode()).digest()[:4], "big") >> 1


def with_measured_tables(truth: TruthSettings, folder: Path) -> TruthSettings:
    """Settings with the measured tables in a folder, a file FABRIC.json for each preset.

    Raises `FileNotFoundError` for one that is missing, and what `arcsim.read_material` raises.
    """
    digest = sha256()
    for fabric in presets.FIVE:
        file = folder / f"{fabric}.json"
        read_material(file)
        digest.update(file.read_bytes())
    return dataclasses.replace(
        truth, materials=str(folder), materials_digest=digest.hexdigest()[:16]
    )


def strain_dependent(name: str, truth: TruthSettings = TruthSettings()) -> Fabric:
    """The fabric that a recording is made with; see `TruthSettings`.

    Raises `ValueError` for an unknown preset.
    """
    if name not in presets.FIVE:
        raise ValueError(f"no preset {name!r}; there are {', '.join(presets.FIVE)}")
    fabric = small_strain(name)
    if truth.materials:
        measured = read_material(Path(truth.materials) / f"{name}.json")
        own = {"damping": fabric.damping, "friction": fabric.friction}  # such files have none
        return dataclasses.replace(measured, **own)
    if not truth.stiffening:
        return fabric
    law, bending = constant_laws(fabric)
    return dataclasses.replace(
        fabric,
        membrane=StiffeningMembrane.make(law, truth.stiffening, STRETCH),
        bending=SofteningPlate(bending, jnp.asarray(SOFTENING, float), jnp.asarray(KNEE, float)),
    )


def small_strain(name: str) -> Fabric:
    """The preset with a truth's own damping and friction: `strain_dependent` at zero strain and
    curvature, which an estimate from a synthetic recording is compared with."""
    damping, friction = (jnp.asarray(value, float) for value in LOSSES[name])
    return dataclasses.replace(presets.FIVE[name](), damping=damping, friction=friction)


def true_fabric(name: str, law: Law, truth: TruthSettings = TruthSettings()) -> Fabric:
    """The fabric that a recording is made with in the laws of an estimate: stiffnesses that it has
    as constants are those at small strain."""
    small, changing, laws = small_strain(name), strain_dependent(name, truth), law.split("+")
    return dataclasses.replace(
        changing,
        membrane=changing.membrane if "stiffening" in laws else small.membrane,
        bending=changing.bending if "softening" in laws else small.bending,
    )
