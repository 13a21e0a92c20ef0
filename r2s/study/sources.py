"""What a study estimates from and judges by: recordings, synthetic or given.

Synthetic recordings are not the estimators' own model: but for folds, whose layers touch, their
mesh is finer than the one that estimates begin on, their steps are shorter, and their fabrics
stiffen with the strain and soften with the curvature, as measured ones do (DIFFCLOUD from a lift
and pulls together estimates such laws, all others constant stiffness). Predictions have their mesh:
what that does is in the floor, and in no error.
Those of a sheet of MuJoCo are of another simulator altogether (`r2s.study.mujoco_cells`).
"""

import dataclasses
import math
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, ClassVar

import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from r2s.compilation import compile_once
from r2s.estimation.default_spaces import Law
from r2s.estimation.pinn.pulls import pulled
from r2s.materials import presets
from r2s.materials.arcsim import read_material
from r2s.materials.fabric import Fabric, constant_laws
from r2s.materials.stiffening import SofteningPlate, StiffeningMembrane
from r2s.recordings import manifest
from r2s.recordings.recording import Recording, load, save
from r2s.scenarios import synthetic
from r2s.scenarios.resolution import explicit_cloth
from r2s.scenarios.scenario import rollout
from r2s.scenarios.standard import STRETCHING_INTERVAL, Experiment
from r2s.study.cells import Cell, result_files
from r2s.study.drawn import RECORDING, START, experiment_of, number_of, pull_of

STRETCH = 1.1  # where half of `TruthSettings.stiffening` is reached; Wang et al. 2011: up to 1.167
SOFTENING, KNEE = 0.35, 20.0  # [-] and [1/m], of a `SofteningPlate`
# Of each truth its own, drawn once within what fabrics have, since no one has measured them.
DAMPING = {
    "camel_ponte_roma": 0.016,
    "black_denim": 0.006,
    "grey_interlock": 0.009,
    "pink_solid": 0.004,
    "red_jet_set": 0.012,
}  # [s]
FRICTION = {
    "camel_ponte_roma": 0.62,
    "black_denim": 0.45,
    "grey_interlock": 0.37,
    "pink_solid": 0.55,
    "red_jet_set": 0.28,
}  # [-]
PULL_FRAMES = 48  # of a pull for `r2s.estimation.pinn`: the longest ends before the last of them
LAYERED = (17, 17)  # vertices at most of a sheet that touches itself, in implicit steps
SAME_SCENARIO = {"lift": "lifting", "fold": "folding"}  # how recordings of others call them


@dataclass(frozen=True)
class TruthSettings:
    """How synthetic recordings are made.

    - `shape`: vertices along warp and weft; of a sheet that touches itself `LAYERED` at most.
    - `max_step`: longest implicit time step, [s], of a sheet that touches itself or is stretched.
      All others go in explicit steps, which leave no error of their own.
    - `stiffening`: stiffness along a yarn far stretched over that of the preset, which is at zero
      strain; half way at an extension of 10 %. Bending softens, too (`r2s.materials.stiffening`).
      Assumed, not measured. 0: constant stiffness, of the membrane and in bending, as the
      estimators assume.
    - `materials`: a folder of ARCSim material files, FABRIC.json of every preset, with measured
      tables to take instead; "": none.
    - `materials_digest`: a hash of those files, from `with_measured_tables`.
    - `self_contact`: whether the sheet touches itself in a fold.
    """

    shape: tuple[int, int] = (33, 33)
    max_step: float = 1 / 90
    stiffening: float = 2.0
    materials: str = ""
    materials_digest: str = ""
    self_contact: bool = True


class Source(Cell):
    """A recording, of a `fabric` in a `scenario`, that is estimated from or judged by."""

    kind: ClassVar[str] = "recordings"
    is_given: ClassVar[bool] = False  # whether it was read, not simulated

    fabric: str  # a field of each class, in an order of its own, as keys have it
    scenario: str

    @property
    def has_start(self) -> bool:
        """Whether the shape of the sheet in the first frame of a judged motion is known."""
        return False

    @property
    def small_strain_fabric(self) -> Fabric | None:
        """The true fabric at small strain, in the laws of r2s; None where it is not known."""
        return None


class SimulatedRecording(Source):
    """A recording of a motion of `r2s.scenarios`, by whichever simulator.

    - `number`: 0 is the motion of the scenario without any numbers; others are drawn within
      `r2s.scenarios.standard.LIMITS`, the same for all fabrics.
    - `unseen`: whether its motion is drawn to be judged by; none of these is one to estimate from.
      Its clouds are all of the surface, without any error.
    """

    number: int
    unseen: bool
    seed: int

    @property
    def has_start(self) -> bool:
        return self.experiment.sheet.weft[2] != 0  # else it lies on the table

    @property
    def experiment(self) -> Experiment:
        """What is done to the sheet."""
        return experiment_of(self.scenario, self.number, self.unseen, self.seed)

    @property
    def sensing(self) -> synthetic.Sensing:
        """How cameras see it."""
        return synthetic.WHOLE if self.unseen else synthetic.sensing(self.experiment)


@dataclass(frozen=True)
class SyntheticRecording(SimulatedRecording):
    """A synthetic recording of a preset's fabric.

    - `angle`: from the pull of a stretching to the warp [degrees], for `r2s.estimation.pinn`; each
      angle and number has a stretch and a rate of its own. None: a motion of `r2s.scenarios`.
    """

    settings: ClassVar[tuple[Any, ...]] = (
        *(STRETCH, SOFTENING, KNEE, DAMPING, FRICTION, PULL_FRAMES, LAYERED),
    )

    fabric: str
    scenario: str
    number: int = 0
    unseen: bool = False
    truth: TruthSettings = TruthSettings()
    seed: int = 0
    angle: float | None = None

    @property
    def name(self) -> str:
        turned = "" if self.angle is None else f"_{self.angle:g}"
        return f"{self.scenario}_{self.fabric}{turned}_{'u' * self.unseen}{self.number}"

    @property
    def compilation_group(self) -> str:
        return f"recordings {self.scenario}"

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        """Simulate the recording."""
        fabric, truth = strain_dependent(self.fabric, self.truth), self.truth
        key = jr.fold_in(jr.key(self.seed), number_of(self.fabric, self.scenario, self.number))
        if self.angle is not None:
            made = pulled(
                fabric,
                self.fabric,
                math.radians(self.angle),
                shape=truth.shape,
                frames=PULL_FRAMES,
                steps=math.ceil(STRETCHING_INTERVAL / truth.max_step - 1e-9),
                key=jr.fold_in(key, round(self.angle)),
                **pull_of(self.number, self.angle, self.seed),
            )
        else:
            made = self._recorded(fabric, out, key)
        info = dataclasses.replace(made.info, name=self.name, trial=str(self.number))
        save(dataclasses.replace(made, info=info), out / RECORDING)
        return {"seed": self.seed, "frames": len(made.times)}

    def _recorded(self, fabric: Fabric, out: Path, key: PRNGKeyArray) -> Recording:
        """A motion of `r2s.scenarios`; of one to judge by also how a hanging sheet starts."""
        truth, layers = self.truth, self.has_layers
        shape = min(truth.shape, LAYERED) if layers else truth.shape
        motion = None
        if not layers and self.scenario != "stretching":
            scenario = self.experiment.scenario(shape)
            motion = _rollout(scenario, fabric, solver=explicit_cloth(scenario, fabric))
            if self.unseen and scenario.brake is not None:
                np.save(out / START, np.asarray(motion.x[0]).reshape(*shape, 3))
        return synthetic.record(
            self.experiment,
            fabric,
            self.fabric,
            seen=self.sensing,
            shape=shape,
            max_step=truth.max_step,
            self_contact=layers,
            motion=motion,
            key=key,
        )

    @property
    def has_layers(self) -> bool:
        """Whether the sheet touches itself."""
        return self.truth.self_contact and self.scenario == "folding"

    @property
    def small_strain_fabric(self) -> Fabric | None:
        return None if self.truth.materials else small_strain(self.fabric)


@dataclass(frozen=True)
class GivenRecording(Source):
    """A recording in a folder with its manifest; `digest`: a hash of its files."""

    is_given: ClassVar[bool] = True

    folder: str
    recording: str
    fabric: str
    scenario: str
    trial: str
    digest: str

    @property
    def name(self) -> str:
        return self.recording

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        """Read the recording, and keep it as it was read."""
        rules = manifest.manifest_for(self.folder)
        read = manifest.read_recording(self.folder, rules, self.recording)
        save(read, out / RECORDING)
        return {"frames": len(read.times), "verified": read.info.verified}


_rollout = compile_once(rollout)


def find_recordings(folder: Path) -> list[GivenRecording]:
    """The recordings in a folder, by its own manifest or that of DIFFCLOUD.

    Raises what `r2s.recordings.manifest` raises, and `ValueError` when there is none.
    """
    rules = manifest.manifest_for(folder)
    found = []
    for name in manifest.read_recordings(folder, rules):
        digest = sha256()
        for file in manifest.sources(folder, rules, name):
            digest.update(file.read_bytes())
        info = manifest.read_recording(folder, rules, name).info
        found.append(
            GivenRecording(
                folder=str(folder),
                recording=name,
                fabric=info.fabric,
                scenario=SAME_SCENARIO.get(info.scenario, info.scenario),
                trial=info.trial,
                digest=digest.hexdigest(),
            )
        )
    if not found:
        raise ValueError(f"{folder}: no recording that a manifest describes")
    return found


def with_measured_tables(truth: TruthSettings, folder: Path) -> TruthSettings:
    """Settings with the measured tables in a folder, one file FABRIC.json for each preset: those
    that a study does not estimate are what others are compared with.

    Raises `FileNotFoundError` for one that is missing, and what `arcsim.read_material`
    raises.
    """
    digest = sha256()
    for fabric in presets.FIVE:
        file = folder / f"{fabric}.json"
        read_material(file)
        digest.update(file.read_bytes())
    return dataclasses.replace(
        truth, materials=str(folder), materials_digest=digest.hexdigest()[:16]
    )


def read(source: Source, folder: Path) -> Recording:
    """The recording of a cell that is made."""
    with result_files(source, folder) as files:
        return load(files / RECORDING)


def read_start(source: Source, folder: Path) -> Float[np.ndarray, "row column 3"] | None:
    """The truth's shape [m] in the first frame of a recording that is judged by, where it hangs.

    None for a sheet that lies on the table, and for given recordings: no one knows theirs.
    """
    if not source.has_start:
        return None
    with result_files(source, folder) as files:
        return np.load(files / START)


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
    """The preset with a truth's own damping and friction.

    Its constant stiffness is that of `strain_dependent` at zero strain and curvature: what an
    estimate from a synthetic recording is compared with.
    """
    damping, friction = (jnp.asarray(each[name], float) for each in (DAMPING, FRICTION))
    return dataclasses.replace(presets.FIVE[name](), damping=damping, friction=friction)


def true_fabric(name: str, law: Law, truth: TruthSettings = TruthSettings()) -> Fabric:
    """The fabric that a recording is made with, of those laws that an estimate has; where it has
    constant ones the stiffness is that at small strain."""
    small, changing = small_strain(name), strain_dependent(name, truth)
    return dataclasses.replace(
        changing,
        membrane=changing.membrane if "stiffening" in law else small.membrane,
        bending=changing.bending if "softening" in law else small.bending,
    )
