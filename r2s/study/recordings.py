"""The recordings that a study estimates from and evaluates on, synthetic or given.

Synthetic recordings do not come from the estimators' own model: except for folds, whose layers
touch, their mesh is finer, their time steps are shorter, and their fabrics stiffen with the strain
and soften with the curvature, as measured ones do. (DIFFCLOUD from a lift and pulls together
estimates such laws; all other configurations have constant stiffness.) Recordings of MuJoCo's sheet
are of another simulator (`r2s.study.mujoco`).
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
from scipy.interpolate import RegularGridInterpolator

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
from r2s.scenarios.paths import draw
from r2s.scenarios.resolution import explicit_cloth
from r2s.scenarios.scenario import Scenario, rollout
from r2s.scenarios.standard import SCENARIOS, STRETCHING_INTERVAL, Experiment
from r2s.study.tasks import Task, result_files

RECORDING = "recording.npz"
START = "start.npy"  # the shape of a hanging sheet in its first frame
STRETCH = 1.1  # where half of `TruthSettings.stiffening` is reached; Wang et al. 2011: up to 1.167
SOFTENING, KNEE = 0.35, 20.0  # [-] and [1/m], of a `SofteningPlate`
# Not measured: one sample for each fabric, within the range of fabrics.
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
    - `materials`: a folder of ARCSim material files, FABRIC.json of every preset, with measured
      tables to use instead; "": none.
    - `materials_digest`: a hash of those files, from `with_measured_tables`.
    - `self_contact`: whether the sheet touches itself in a fold.
    """

    shape: tuple[int, int] = (33, 33)
    max_step: float = 1 / 90
    stiffening: float = 2.0
    materials: str = ""
    materials_digest: str = ""
    self_contact: bool = True


class Source(Task):
    """A recording of a `fabric` in a `scenario`."""

    kind: ClassVar[str] = "recordings"
    is_given: ClassVar[bool] = False  # read, not simulated

    fabric: str  # fields of each subclass, in the order that keys have
    scenario: str

    @property
    def has_start(self) -> bool:
        """Whether the shape of the sheet in the first frame is known."""
        return False

    @property
    def small_strain_fabric(self) -> Fabric | None:
        """The true fabric at small strain, in the laws of r2s; None where it is not known."""
        return None


class SimulatedRecording(Source):
    """A recording of a motion of `r2s.scenarios`, by any simulator.

    - `number`: 0 is the scenario's standard motion; others are sampled within
      `r2s.scenarios.paths.LIMITS`, the same for all fabrics.
    - `unseen`: whether it is for evaluation: its motion is none to estimate from, and its clouds
      are the whole surface without noise.
    """

    number: int
    unseen: bool
    seed: int

    @property
    def has_start(self) -> bool:
        return self.experiment.sheet.weft[2] != 0  # else it lies on the table

    @property
    def experiment(self) -> Experiment:
        return experiment_of(self.scenario, self.number, self.unseen, self.seed)

    @property
    def sensing(self) -> synthetic.Sensing:
        """How cameras observe it."""
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

    @property
    def has_layers(self) -> bool:
        """Whether the sheet touches itself."""
        return self.truth.self_contact and self.scenario == "folding"

    @property
    def small_strain_fabric(self) -> Fabric | None:
        return None if self.truth.materials else small_strain(self.fabric)

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
        """A motion of `r2s.scenarios`; writes the start of a hanging sheet for evaluation."""
        truth, layers, motion = self.truth, self.has_layers, None
        shape = min(truth.shape, LAYERED) if layers else truth.shape
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
        """Read the recording, and store it as it was read."""
        rules = manifest.manifest_for(self.folder)
        found = manifest.read_recording(self.folder, rules, self.recording)
        save(found, out / RECORDING)
        return {"frames": len(found.times), "verified": found.info.verified}


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
        scenario = SAME_SCENARIO.get(info.scenario, info.scenario)
        place = (str(folder), name, info.fabric, scenario, info.trial)
        found.append(GivenRecording(*place, digest.hexdigest()))
    if not found:
        raise ValueError(f"{folder}: no recording that a manifest describes")
    return found


def read(source: Source, folder: Path) -> Recording:
    """The recording of a finished task."""
    with result_files(source, folder) as files:
        return load(files / RECORDING)


def read_start(source: Source, folder: Path) -> Shape | None:
    """The true shape [m] of a hanging sheet in the first frame of a recording for evaluation.

    None for a sheet that lies on the table, and for given recordings, where it is not known.
    """
    if not source.has_start:
        return None
    with result_files(source, folder) as files:
        return np.load(files / START)


def started(scenario: Scenario, shape: Shape | None) -> Scenario:
    """A scenario whose sheet starts in a shape and settles for `SETTLING` before it moves.

    A sheet that hangs from corners drawn together buckles into one of several shapes, by mesh and
    fabric: from a flat sheet the true fabric on another mesh may begin a centimetre away. The cloud
    of the first frame does not fix that shape (a sheet laid onto it leaves it within 0.2 s); the
    truth's own shape does.

    - `shape`: positions [m] of a regular grid of the sheet in the first frame, along warp and
      weft; None: unknown, the scenario is unchanged.

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


def experiment_of(scenario: str, number: int, unseen: bool, seed: int) -> Experiment:
    """Motion `number` of a scenario, the same for all fabrics; see `SimulatedRecording`."""
    if number == 0 and not unseen:
        return SCENARIOS[scenario]()
    return SCENARIOS[scenario](**numbers_of(scenario, number, unseen, seed))


def numbers_of(scenario: str, number: int, unseen: bool, seed: int) -> dict[str, float]:
    """The sampled parameters of a motion."""
    key = jr.fold_in(jr.key(seed), number_of(scenario))  # scenarios do not share their numbers
    return draw(scenario, 1, key=jr.fold_in(key, 2 * number + unseen))[0]


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
    damping, friction = (jnp.asarray(each[name], float) for each in (DAMPING, FRICTION))
    return dataclasses.replace(presets.FIVE[name](), damping=damping, friction=friction)


def true_fabric(name: str, law: Law, truth: TruthSettings = TruthSettings()) -> Fabric:
    """The fabric that a recording is made with in the laws of an estimate: stiffnesses that it has
    as constants are those at small strain."""
    small, changing = small_strain(name), strain_dependent(name, truth)
    return dataclasses.replace(
        changing,
        membrane=changing.membrane if "stiffening" in law else small.membrane,
        bending=changing.bending if "softening" in law else small.bending,
    )
