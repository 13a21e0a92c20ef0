"""What mesh and step leave in the motion of MuJoCo's sheet, and whether that motion is chaotic."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from r2s.scenarios.standard import Experiment
from r2s.study.mujoco_sheet import SHEET, STUDIED, Material, Resolution, motion

SOFTER = 1e-3  # [-], by which Young's modulus is changed to see how much that grows
VARIANTS = ("half the step", "finer mesh", "stiffness +0.1 %")
ENOUGH = 2e-3  # [m], below which a truth is called converged


class Difference(NamedTuple):
    """Between two motions, [m]: rms over sheet and frames, and the greatest rms of a frame."""

    rms: float
    worst: float


def differences(
    experiment: Experiment,
    variants: tuple[str, ...] = VARIANTS,
    material: Material = SHEET,
    resolution: Resolution = STUDIED,
) -> dict[str, Difference]:
    """How far a motion is from that in half the step, on a mesh of 3/2 as many cells a side, and
    of a fabric 0.1 % stiffer: the last says whether the motion is chaotic.

    Raises as `r2s.study.mujoco_sheet.motion`, and `ValueError` where the cells have no half.
    """
    if any(count % 2 == 0 for count in resolution.shape):
        raise ValueError(f"a finer mesh needs odd numbers of vertices, got {resolution.shape}")
    x = places(motion(experiment, material, resolution), resolution.shape)
    found = {}
    for variant in variants:
        of, at = varied(variant, material, resolution)
        found[variant] = difference(places(motion(experiment, of, at), at.shape), x)
    return found


def varied(variant: str, material: Material, resolution: Resolution) -> tuple[Material, Resolution]:
    """The material and the resolution of a variant."""
    shape, step = resolution
    if variant == "finer mesh":
        warp, weft = (3 * (count - 1) // 2 + 1 for count in shape)
        return material, Resolution((warp, weft), step)
    if variant == "half the step":
        return material, Resolution(shape, step / 2)
    return material._replace(young=(1 + SOFTER) * material.young), resolution


def places(
    x: Float[np.ndarray, "frame vertex 3"], shape: tuple[int, int], cells: int = 12
) -> Float[np.ndarray, "frame place 3"]:
    """Of the vertices of a sheet those that all its meshes share: `cells` a side, and the end.

    Raises `ValueError` where the mesh has no such vertices.
    """
    if any((count - 1) % cells for count in shape):
        raise ValueError(f"a sheet of {shape} vertices has no {cells} equal parts")
    every = [(count - 1) // cells for count in shape]
    return x.reshape(len(x), *shape, 3)[:, :: every[0], :: every[1]].reshape(len(x), -1, 3)


def difference(
    x: Float[np.ndarray, "frame place 3"], y: Float[np.ndarray, "frame place 3"]
) -> Difference:
    """Between the same places in two motions."""
    of_frame = np.sqrt(np.square(x - y).sum(axis=-1).mean(axis=-1))
    return Difference(float(np.sqrt(np.square(of_frame).mean())), float(of_frame.max()))
