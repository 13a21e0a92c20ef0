"""Training data: depth images of simulated motions of many fabrics, in reproducible shards."""

import dataclasses
import io
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Float, Int, UInt

from r2s._util.files import read_json, read_npz, write_bytes, write_json
from r2s.estimation.physnet.images import View, depths_of_sheet, per_face, view_of
from r2s.materials.fabric import Fabric
from r2s.materials.parameters import IsotropicSpace, OrthotropicSpace, ParameterSpace, Range
from r2s.scenarios.resolution import mpm_cloth
from r2s.scenarios.scenario import Scenario, rollout
from r2s.scenarios.standard import SCENARIOS, Experiment, varied
from r2s.solvers.mpm.sheet import MPMCloth

DEPTH_UNIT = 1e-4  # [m], of the depths in the files
DENSITY = 0.2  # [kg/m^2], of all fabrics


@dataclass(frozen=True)
class Settings:
    """The settings that determine a data set.

    - `scenario`: a name in `r2s.scenarios.SCENARIOS`.
    - `num_fabrics`: fabrics, drawn uniformly from the unit cube of the space.
    - `num_levels`: motions of each fabric, the same for all of a shard; see `levels`.
    - `num_frames`: frames of each motion, evenly spread over those that count.
    - `size`: side of the images, [pixel].
    - `shape`: vertices of the sheet along warp and weft.
    - `ranges`: of the space; without ranges its defaults.
    - `solver`: "cloth" of orthotropic fabrics, or "mpm" (material points) of isotropic ones.
    - `per_shard`: fabrics in a file.
    """

    scenario: str = "lifting"
    num_fabrics: int = 512
    num_levels: int = 6
    num_frames: int = 8
    size: int = 64
    shape: tuple[int, int] = (9, 9)
    ranges: tuple[Range, ...] = ()
    solver: str = "cloth"
    per_shard: int = 16
    seed: int = 0

    @property
    def space(self) -> ParameterSpace:
        """The fabrics from which those of the data are drawn."""
        space = (IsotropicSpace if self.solver == "mpm" else OrthotropicSpace).make(DENSITY)
        return dataclasses.replace(space, ranges=self.ranges) if self.ranges else space

    @property
    def num_shards(self) -> int:
        """Number of files."""
        return -(-self.num_fabrics // self.per_shard)


@dataclass(frozen=True)
class Manifest:
    """The file `manifest.json`: settings and view of the data."""

    settings: Settings
    view: View


class Data(NamedTuple):
    """Images of all motions that did not diverge.

    - `depth`: depths in units of `DEPTH_UNIT`; 0 where there is none.
    - `fabric`: index of each motion's fabric.
    - `places`: all fabrics as points of the unit cube.
    """

    depth: UInt[np.ndarray, "motion frame down across"]
    fabric: Int[np.ndarray, " motion"]
    places: Float[np.ndarray, "fabric dim"]


def make(folder: Path | str, settings: Settings, progress: bool = True) -> Manifest:
    """Write a manifest and the missing shards of a data set.

    A shard depends on the settings and on its own number alone, so that an interrupted call can be
    repeated. The motions of the first shard determine the view. Raises `ValueError` when the folder
    has data of other settings.
    """
    from tqdm import tqdm

    folder, view = Path(folder), None
    folder.mkdir(parents=True, exist_ok=True)
    if (folder / "manifest.json").exists():
        stored = load_manifest(folder)
        if stored.settings != settings:
            raise ValueError(f"{folder} has data of other settings: remove it, or choose another")
        view = stored.view
    missing = [n for n in range(settings.num_shards) if not _shard(folder, n).exists()]
    substeps, solver = _shared(settings) if missing else (1, None)
    for number in tqdm(missing, "shards", disable=None if progress else True):
        places, x, ok = _simulate(settings, number, substeps, solver)
        if view is None:
            view = view_of(SCENARIOS[settings.scenario](), x[ok].reshape(-1, 3), settings.size)
        write_json(folder / "manifest.json", asdict(Manifest(settings, view)))
        _write(_shard(folder, number), settings, view, places, x, ok)
    return load_manifest(folder)


def load_manifest(folder: Path | str) -> Manifest:
    """The manifest of a data set. Raises `ValueError` that names the file when it is damaged."""
    return read_json(Path(folder) / "manifest.json", Manifest)


def load(folder: Path | str) -> Data:
    """All shards of a data set. Raises `ValueError` that names what is missing or damaged."""
    folder, names = Path(folder), ("ok", "depth", "places")
    settings, parts = load_manifest(folder).settings, []
    for number in range(settings.num_shards):
        path = _shard(folder, number)
        try:
            arrays = read_npz(path, *names)
        except (FileNotFoundError, ValueError) as error:
            raise ValueError(f"{path} is missing or damaged: remove it and begin again") from error
        parts.append([arrays[name] for name in names])
    ok, depth, places = (np.concatenate(part) for part in zip(*parts, strict=True))
    fabric = np.repeat(np.arange(len(places)), settings.num_levels)
    return Data(depth[ok], fabric[ok], places)


def levels(settings: Settings, number: int = 0) -> list[Experiment]:
    """The motions of every fabric of a shard: the scenario's own, and random variations of it.

    Each shard has variations of its own, so that a network cannot learn them by heart.
    """
    key = jr.fold_in(jr.key(settings.seed), 2**20 + number)  # different from that of the fabrics
    others = varied(settings.scenario, settings.num_levels - 1, key=key)
    return [SCENARIOS[settings.scenario](), *others]


def frame_indices(used: tuple[int, int], number: int) -> tuple[int, ...]:
    """The indices of `number` frames, evenly spread from the first to the last that counts."""
    first, last = used
    return tuple(int(frame) for frame in np.linspace(first, last, number).round())


def _shard(folder: Path, number: int) -> Path:
    return folder / f"{number:04d}.npz"


def _shared(settings: Settings) -> tuple[int, MPMCloth | None]:
    """The steps between frames and the solver of all shards, so that they compile once.

    The solver is None for the cloth, or material points whose step and grid serve all motions.
    """
    shards = range(settings.num_shards)
    experiments = [experiment for i in shards for experiment in levels(settings, i)[i > 0 :]]
    scenarios = [experiment.scenario(settings.shape) for experiment in experiments]
    substeps = max(scenario.substeps for scenario in scenarios)
    if settings.solver == "cloth":
        return substeps, None
    path = jnp.concatenate([scenario.path for scenario in scenarios])
    times = jnp.concatenate([scenario.path_times for scenario in scenarios])
    space = settings.space
    stiffest = space(jnp.ones(space.dim, float))
    everywhere = dataclasses.replace(scenarios[0], path=path, path_times=times)
    return substeps, mpm_cloth(everywhere, stiffest)


@eqx.filter_jit
def _rollouts(scenarios: Scenario, fabrics: Fabric, solver: MPMCloth | None):
    def one(scenario: Scenario, fabric: Fabric):
        # the grid serves all scenarios, but each has a fan of its own
        own = solver and eqx.tree_at(lambda s: s.scene, solver, scenario.scene)
        motion = rollout(scenario, fabric, solver=own)
        return motion.x, jnp.all(motion.ok) & jnp.all(jnp.isfinite(motion.x))

    return eqx.filter_vmap(one)(scenarios, fabrics)


def _simulate(settings: Settings, number: int, substeps: int, solver: MPMCloth | None):
    """Places of the fabrics, motions [m] and which of them are ok, of a shard."""
    count = min(settings.per_shard, settings.num_fabrics - number * settings.per_shard)
    # always a whole shard, so that it compiles once and does not depend on the number of fabrics
    key = jr.fold_in(jr.key(settings.seed), number)
    places = jr.uniform(key, (settings.per_shard, settings.space.dim), float)
    experiments = levels(settings, number)
    scenarios = [
        dataclasses.replace(experiment.scenario(settings.shape), substeps=substeps)
        for experiment in experiments
    ]
    fabrics = jax.vmap(settings.space)(jnp.repeat(places, settings.num_levels, axis=0))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenarios * settings.per_shard)
    x, ok = _rollouts(stacked, fabrics, solver)
    motions = count * settings.num_levels
    frames = np.array(frame_indices(experiments[0].frames_used, settings.num_frames))
    return np.asarray(places)[:count], np.asarray(x)[:motions, frames], np.asarray(ok)[:motions]


_depths = eqx.filter_jit(eqx.filter_vmap(depths_of_sheet, in_axes=(None, 0, None, None)))


def _write(path: Path, settings: Settings, view: View, places, x, ok) -> None:
    """Write a shard with depths in units of `DEPTH_UNIT`."""
    experiment = SCENARIOS[settings.scenario]()
    faces = experiment.scenario(settings.shape).scene.mesh.faces
    fine = per_face(view, settings.shape, experiment.sheet.size)
    x = jnp.asarray(np.where(np.isfinite(x), x, 0))
    depth = np.rint(np.asarray(_depths(view, x, faces, fine)) / DEPTH_UNIT).astype(np.uint16)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, depth=depth, places=places, ok=ok)
    write_bytes(path, buffer.getvalue())
