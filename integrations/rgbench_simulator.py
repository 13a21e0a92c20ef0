"""r2s as a simulator of RGBench (Hu et al. 2025, arXiv:2511.06434): its environment interface.

RGBench steps whatever has `step_to_time` and `get_sim_vertices`. In `rgbench/envs/__init__.py` add

    if "r2s" in env_name:
        from rgbench_simulator import Environment
        return Environment(cfg=env_cfg, **kwargs)

and a file `configs/env/r2s.yaml`, whose `card` is a fabric card of r2s or the name of a preset:

    name: r2s
    card: /path/of/a/card.json
    spacing: 0.02      # [m], between vertices
    timestep: 0.01     # [s]

then run with `params.sim_environment=r2s params.sim_mode=fixed_point`. A garment is simulated as
one sheet cut to its outline, as heavy as the garment, of as many layers of the card's fabric as
that makes: seams and the air between layers are not in it. Written after the public code (commit
1631f595) and tried on files of its layout; neither its own meshes nor its captures were at hand.
"""

import dataclasses
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from rgbench_captures import BASES, read_arm
from scipy.ndimage import binary_closing, binary_fill_holes, label
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from r2s.environment.scene import Control, Scene
from r2s.estimation import cards
from r2s.materials import presets
from r2s.materials.fabric import Fabric, constant_laws
from r2s.mesh.mesh import Mesh, rectangle
from r2s.recordings.clouds import read_cloud
from r2s.recordings.recording import interpolated
from r2s.solvers.implicit.cloth import ImplicitCloth

SPACING, TIMESTEP = 0.02, 0.01  # [m], [s]
MOVES = ("grasp", "fold", "fling")


class Environment:
    """What RGBench asks of a simulator, see `rgbench.envs.base.BaseEnvWrapper`.

    Times are in seconds from the first sample of the arms' paths, positions in metres in RGBench's
    world, z up, with the table at z = 0.
    """

    def __init__(self, cfg: Any, **_: Any) -> None:
        """From the configuration of a run; see the module for what is r2s's own in it.

        Raises `ValueError` that names the key: one that is missing, a motion that RGBench does not
        have; and as `read_arm`, `r2s.estimation.cards.read` and `garment` do.
        """
        self.cfg = cfg
        move = _value(cfg, "action.type", "grasp")
        if move not in MOVES:
            raise ValueError(f"action.type is one of {', '.join(MOVES)}, got {move!r}")
        self._arms = [
            read_arm(Path(_value(cfg, f"data.robot_joints.{arm}_arm_csv_path")), base)
            for arm, base in BASES.items()
        ]
        self._start = min(float(times[0]) for times, _ in self._arms)
        self._is_fling = move == "fling"
        self._prepare = float(_value(cfg, "action.fling_prepare_time", 2.0))
        self._wait = float(_value(cfg, "action.fling_wait_time", 3.0))
        self._grab = float(_value(cfg, "evaluate.start_calculate_time", 0.0))
        self.dt = float(_value(cfg, "env.timestep", TIMESTEP))
        pose = np.asarray(_value(cfg, "cloth.init_pose", [0, 0, 0, 1, 0, 0, 0]), float)
        turn = Rotation.from_quat(pose[[4, 5, 6, 3]])  # RGBench writes w first
        lying = turn.apply(read_cloud(_value(cfg, "cloth.model_path"))) + pose[:3]
        mesh = garment(lying[:, :2], float(_value(cfg, "env.spacing", SPACING)))
        mass = float(_value(cfg, "cloth_params.mass"))
        name = str(_value(cfg, "env.card"))
        card = cards.preset(name) if name in presets.MEASURED else cards.read(name)
        self.fabric = layered(card.fabric, mass / float(jnp.sum(mesh.area)))
        flat = np.concatenate([mesh.rest, np.full((len(mesh.rest), 1), self.fabric.thickness)], 1)
        grips = self._grippers(self._grab)
        if self._is_fling:
            grips = lying[list(_value(cfg, "cloth_params.shoulder_index"))]
        if len(grips) != len(BASES):
            raise ValueError(f"cloth_params.shoulder_index: expected two, found {len(grips)}")
        self._held = np.asarray(KDTree(flat[:, :2]).query(grips[:, :2])[1])
        if len(np.unique(self._held)) < len(BASES):
            raise ValueError("both arms hold one vertex of the sheet: take a smaller env.spacing")
        self._from = flat[self._held]
        scene = Scene(mesh, self._held, table=0.0)
        solver = ImplicitCloth(scene, self.dt)
        self._step = eqx.filter_jit(solver.step)
        self._state = solver.init(jnp.asarray(flat, float))
        self._count = 0

    def step(self) -> None:
        """One time step. Raises `FloatingPointError` that says when, once a step has failed."""
        time = (self._count + 1) * self.dt
        control = Control(jnp.asarray(self._path(time), float), jnp.zeros(3))
        self._state = self._step(self.fabric, self._state, control)
        self._count += 1
        if not bool(jnp.all(jnp.isfinite(self._state.x))):
            raise FloatingPointError(f"the simulation failed in the step to {time:.3f} s")

    def step_to_time(self, target_time: float) -> None:
        """Steps until a time [s] is reached."""
        while self.get_current_sim_time() < target_time - 1e-9:
            self.step()

    def get_sim_vertices(self) -> Float[np.ndarray, "vertex 3"]:
        """Where the sheet's vertices are now, [m]."""
        return np.asarray(self._state.x, float)

    def get_master_start_time(self) -> float:
        """The time of the first sample of the arms' paths, [s]."""
        return self._start

    def get_current_sim_time(self) -> float:
        """The time that was simulated, [s]."""
        return self._count * self.dt

    def close(self) -> None:
        """Nothing to release."""

    def _grippers(self, time: float) -> Float[np.ndarray, "2 3"]:
        """Where the grippers are [m], a time [s] after the start; at rest before and after."""
        at = np.array([self._start + time])
        return np.concatenate([interpolated(at, times, places) for times, places in self._arms])

    def _path(self, time: float) -> Float[np.ndarray, "2 3"]:
        """Where the pinned vertices are at a time [s]: before a fling the sheet is lifted to where
        the arms begin, and waits there; else it lies until it is grabbed."""
        if not self._is_fling:
            return self._from if time < self._grab else self._grippers(time)
        begin = self._grippers(0.0)
        if time < self._prepare:
            return self._from + time / self._prepare * (begin - self._from)
        return self._grippers(max(time - self._prepare - self._wait, 0.0))


def layered(fabric: Fabric, density: float) -> Fabric:
    """A sheet of an areal density [kg/m^2] made of layers of a fabric that lie on each other
    without friction: its stiffnesses are so many times the fabric's.

    Raises `TypeError` for a fabric whose stiffness is not constant.
    """
    membrane, bending = constant_laws(fabric)
    layers = density / fabric.density
    return dataclasses.replace(
        fabric,
        density=jnp.asarray(density, float),
        membrane=jax.tree.map(lambda stiffness: layers * stiffness, membrane),
        bending=dataclasses.replace(bending, stiffness=layers * bending.stiffness),
    )


def garment(points: Float[np.ndarray, "point 2"], spacing: float) -> Mesh:
    """The sheet that a garment covers as it lies, from points all over it, [m].

    A cell of a grid, about `spacing` [m] wide, is of the sheet where there are points in it, or
    all around it. What is not connected to the largest part is left out.

    Raises `ValueError` for a spacing at which the points leave the sheet in pieces.
    """
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    size = np.maximum(np.round(extent / spacing), 1).astype(int)
    width = extent / size
    cells = np.clip(np.floor((points - low) / width), 0, size - 1).astype(int)
    inside = np.zeros(tuple(size + 2), bool)  # with a border, which closing needs
    inside[tuple(cells.T + 1)] = True
    inside = np.asarray(binary_fill_holes(binary_closing(inside)))[1:-1, 1:-1]
    parts = np.zeros(inside.shape, int)
    label(inside, output=parts)
    largest = parts == 1 + np.argmax(np.bincount(parts.ravel())[1:])
    if largest.sum() < 0.9 * inside.sum():
        raise ValueError(f"at a spacing of {spacing} m the garment is in pieces: take a larger one")
    rows, columns = (int(count) for count in size)
    whole = rectangle((float(extent[0]), float(extent[1])), (rows + 1, columns + 1), "alternating")
    faces = np.asarray(whole.faces)[np.tile(largest.ravel(), 2)]  # two triangles a cell
    used, faces = np.unique(faces, return_inverse=True)
    return Mesh.make(low + np.asarray(whole.rest)[used], faces.reshape(-1, 3))


def _value(cfg: Any, key: str, *default: Any) -> Any:
    """A value of a configuration whose parts are attributes, as those of OmegaConf are."""
    value = cfg
    for name in key.split("."):
        value = getattr(value, name, None)
    if value is None and not default:
        raise ValueError(f"the configuration lacks {key}")
    return default[0] if value is None else value
