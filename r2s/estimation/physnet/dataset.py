"""Training data: motions of many fabrics as depth images, in shards that a seed makes again."""

import dataclasses
import hashlib
import io
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Float, Int, UInt

from r2s.estimation.physnet.views import (
    View,
    depths_of_sheet,
    eye_of,
    floor_of,
    per_face,
    view_around,
)
from r2s.fabrics.fabric import Fabric
from r2s.fabrics.parameters import IsotropicSpace, OrthotropicSpace, ParameterSpace, Range
from r2s.files import read_json, write_bytes, write_json
from r2s.mpm.sheet import Sheet
from r2s.scenarios.on_points import material_points
from r2s.scenarios.scenario import Scenario, rollout
from r2s.scenarios.six import SIX, Experiment, varied

FORMAT = "r2s-physnet-data/2"
STEP = 1e-4  # [m], of the depths in the files


@dataclass(frozen=True)
class Settings:
    """What a data set holds; all of it follows from these.

    - `scenario`: a name in `r2s.scenarios.SIX`.
    - `num_fabrics`: the classes, drawn evenly from the unit cube of the space.
    - `num_levels`: motions of each, the same for all of a shard; see `levels`.
    - `num_frames`: kept of each motion, evenly spread over those that count.
    - `size`: of the images, [pixel]. - `shape`: vertices along warp and weft.
    - `density` [kg/m^2], `thickness` [m], `ranges`: of the space; no ranges: its own.
    - `isotropic`: fabrics of E h and Poisson's ratio, not orthotropic ones.
    - `material_points`: by these instead of the cloth.
    - `per_shard`: fabrics in a file. - `seed`.
    """

    scenario: str = "lifting"
    num_fabrics: int = 512
    num_levels: int = 6
    num_frames: int = 8
    size: int = 64
    shape: tuple[int, int] = (9, 9)
    density: float = 0.2
    thickness: float = 1e-3
    ranges: tuple[Range, ...] = ()
    material_points: bool = False
    per_shard: int = 16
    seed: int = 0
    isotropic: bool = False

    def __post_init__(self) -> None:
        plain = self._plain().ranges
        if not self.ranges:  # written down with the data, whatever they will be by default
            object.__setattr__(self, "ranges", plain)
        names, expected = ([bound.name for bound in ranges] for ranges in (self.ranges, plain))
        if names[: len(expected)] != expected:
            raise ValueError(f"the space has the ranges {expected}, found {names}")
        if self.scenario not in SIX:
            raise ValueError(f"scenario must be one of {list(SIX)}, found {self.scenario!r}")
        for name in ("num_fabrics", "num_levels", "num_frames", "per_shard"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, found {getattr(self, name)}")

    @property
    def space(self) -> ParameterSpace:
        return dataclasses.replace(self._plain(), ranges=self.ranges)

    def _plain(self) -> OrthotropicSpace | IsotropicSpace:
        if self.isotropic:
            return IsotropicSpace.make(self.density, thickness=self.thickness)
        return OrthotropicSpace.make(self.density, self.thickness)


@dataclass(frozen=True)
class Manifest:
    """`manifest.json`: how the data were made, the view, and the SHA-256 of every shard so far."""

    format: str
    settings: Settings
    view: View
    shards: Mapping[str, str]


class Data(NamedTuple):
    """Images of motions; a motion that diverged is left out.

    - `depth`: in units of `STEP`, 0 where there is none.
    - `fabric`: which one a motion is of. - `places`: of all fabrics in the unit cube.
    """

    depth: UInt[np.ndarray, "motion frame down across"]
    fabric: Int[np.ndarray, " motion"]
    places: Float[np.ndarray, "fabric dim"]


@eqx.filter_jit
def _moved(scenarios: Scenario, fabrics: Fabric, solver: Sheet | None):
    def one(scenario: Scenario, fabric: Fabric):
        # the grid serves all scenarios, the fan is each one's own
        own = solver and eqx.tree_at(lambda s: s.scene, solver, scenario.scene)
        found = rollout(scenario, fabric, solver=own)
        return found.x, jnp.all(found.ok) & jnp.all(jnp.isfinite(found.x))

    return eqx.filter_vmap(one)(scenarios, fabrics)


_seen = eqx.filter_jit(eqx.filter_vmap(depths_of_sheet, in_axes=(None, 0, None, None)))


def make(
    folder: Path | str, settings: Settings, progress: bool = True, view: View | None = None
) -> Manifest:
    """Write the shards of a data set that are not there yet, and its manifest after each.

    A shard depends on the seed and on its own number alone, so an interrupted call goes on with
    the same numbers. The view is that of all motions of the first shard, or the one given: that of
    other data, for their network. Raises `ValueError` when the folder has data of other settings or
    of another view.
    """
    from tqdm import tqdm

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    known = load_manifest(folder) if (folder / "manifest.json").exists() else None
    if known is not None and known.settings != settings:
        raise ValueError(
            f"{folder} has data of other settings: {_differences(known.settings, settings)}; "
            "choose another folder"
        )
    if known is not None and view not in (None, known.view):
        raise ValueError(f"{folder} has data of {known.view}, asked for {view}")
    shards = dict(known.shards) if known else {}
    view = known.view if known else view
    starts = range(0, settings.num_fabrics, settings.per_shard)
    shared = None
    for number, _ in enumerate(tqdm(starts, "shards", disable=None if progress else True)):
        name = f"{number:04d}.npz"
        if view is not None and _is_whole(folder / name, shards.get(name)):
            continue
        shared = alike(settings) if shared is None else shared
        experiments, places, x, ok = _simulate(settings, number, shared)
        if view is None:  # the first shard says where sheets go
            view = _fit(settings, experiments[0], x[ok])
        shards[name] = _write(folder / name, settings, view, places, x, ok)
        manifest = Manifest(FORMAT, settings, view, dict(sorted(shards.items())))
        write_json(folder / "manifest.json", asdict(manifest))
    return load_manifest(folder)


def load_manifest(folder: Path | str) -> Manifest:
    """The manifest of a data set; `ValueError` that names the file when it is none."""
    path = Path(folder) / "manifest.json"
    manifest = read_json(path, Manifest)
    if manifest.format != FORMAT:
        raise ValueError(f"{path}: expected format {FORMAT}, found {manifest.format}")
    return manifest


def load(folder: Path | str) -> Data:
    """All shards of a data set. Raises `ValueError` that names what is missing or damaged."""
    folder = Path(folder)
    settings, shards = load_manifest(folder).settings, load_manifest(folder).shards
    expected = -(-settings.num_fabrics // settings.per_shard)
    if len(shards) != expected:
        raise ValueError(
            f"{folder} has {len(shards)} of {expected} shards: make the data set again, it goes on"
        )
    parts: list[Any] = []
    for name, digest in shards.items():
        if not _is_whole(folder / name, digest):
            raise ValueError(f"{folder / name} is missing or damaged: make the data set again")
        with np.load(folder / name, allow_pickle=False) as file:
            parts.append({key: file[key] for key in file.files})
    ok = np.concatenate([part["ok"] for part in parts])
    depth = np.concatenate([part["depth"] for part in parts])
    places = np.concatenate([part["places"] for part in parts])
    fabric = np.repeat(np.arange(len(places)), settings.num_levels)
    return Data(depth[ok], fabric[ok], places)


def levels(settings: Settings, number: int = 0) -> list[Experiment]:
    """The motions of every fabric of a shard: the scenario's own, and others within
    `trajectories.LIMITS`, of which each shard has its own: so a network cannot learn them by heart.
    """
    key = jr.fold_in(jr.key(settings.seed), 2**20 + number)  # not that of the fabrics
    return [SIX[settings.scenario](), *varied(settings.scenario, settings.num_levels - 1, key=key)]


def every_level(settings: Settings) -> list[Experiment]:
    """The motions of all shards."""
    shards = -(-settings.num_fabrics // settings.per_shard)
    first, *others = levels(settings)
    return [first, *others, *(e for i in range(1, shards) for e in levels(settings, i)[1:])]


def stacked(scenarios: list[Scenario], most: int | None = None) -> Scenario:
    """Scenarios with a leading axis on their arrays, all with `most` steps between frames, or as
    the one with most."""
    most = max(scenario.substeps for scenario in scenarios) if most is None else most
    alike = [dataclasses.replace(scenario, substeps=most) for scenario in scenarios]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *alike)


def solver_of(settings: Settings, scenarios: list[Scenario]) -> Sheet | None:
    """None for the cloth; else material points whose step and grid serve all these motions."""
    if not settings.material_points:
        return None
    paths, times = (
        jnp.concatenate([getattr(scenario, name) for scenario in scenarios])
        for name in ("path", "path_times")
    )
    stiffest = settings.space(jnp.ones(len(settings.ranges), float))
    everywhere = dataclasses.replace(scenarios[0], path=paths, path_times=times)
    return material_points(everywhere, stiffest)


def kept_frames(used: tuple[int, int], number: int) -> tuple[int, ...]:
    """`number` frames evenly spread from the first to the last that counts."""
    first, last = used
    return tuple(int(frame) for frame in np.linspace(first, last, number).round())


class Alike(NamedTuple):
    """What all shards share, so that they compile once: steps between frames, and the solver."""

    substeps: int
    solver: Sheet | None


def alike(settings: Settings) -> Alike:
    """For the motions of all shards."""
    scenarios = [experiment.scenario(settings.shape) for experiment in every_level(settings)]
    return Alike(max(s.substeps for s in scenarios), solver_of(settings, scenarios))


def _simulate(settings: Settings, number: int, alike: Alike):
    """The experiments of a shard, its fabrics' places, and their motions [m], with which are ok."""
    first = number * settings.per_shard
    count = min(settings.per_shard, settings.num_fabrics - first)
    # always a whole shard, so that it compiles once and the last fabrics do not depend on how many
    key = jr.fold_in(jr.key(settings.seed), number)
    places = jr.uniform(key, (settings.per_shard, len(settings.ranges)), float)
    experiments = levels(settings, number)
    scenarios = [experiment.scenario(settings.shape) for experiment in experiments]
    fabrics = jax.vmap(settings.space)(jnp.repeat(places, settings.num_levels, axis=0))
    repeated = stacked(scenarios * settings.per_shard, alike.substeps)
    x, ok = _moved(repeated, fabrics, alike.solver)
    motions = count * settings.num_levels
    frames = np.array(kept_frames(experiments[0].frames_used, settings.num_frames))
    return (
        experiments,
        np.asarray(places)[:count],
        np.asarray(x)[:motions, frames],
        np.asarray(ok)[:motions],
    )


def _fit(settings: Settings, experiment: Experiment, x: np.ndarray) -> View:
    points = x.reshape(-1, 3)
    return view_around(eye_of(experiment), points, settings.size, floor_of(experiment))


def _write(path: Path, settings: Settings, view: View, places, x, ok) -> str:
    """Write a shard; its SHA-256. Depths are in units of `STEP`, as cameras give them."""
    experiment = SIX[settings.scenario]()
    faces = experiment.scenario(settings.shape).scene.mesh.faces
    fine = per_face(view, settings.shape, experiment.sheet.size)
    depth = np.asarray(_seen(view, jnp.asarray(np.where(np.isfinite(x), x, 0)), faces, fine))
    buffer = io.BytesIO()
    np.savez_compressed(buffer, depth=np.rint(depth / STEP).astype(np.uint16), places=places, ok=ok)
    write_bytes(path, buffer.getvalue())
    return hashlib.sha256(buffer.getvalue()).hexdigest()


def _is_whole(path: Path, digest: str | None) -> bool:
    if digest is None or not path.exists():
        return False
    return hashlib.sha256(path.read_bytes()).hexdigest() == digest


def _differences(known: Settings, asked: Settings) -> str:
    old, new = asdict(known), asdict(asked)
    return ", ".join(
        f"{key} {old[key]} there, {new[key]} asked" for key in old if old[key] != new[key]
    )
