"""The Cusick drape test (BS EN ISO 9073-9): a disc of fabric that hangs over a smaller one.

The drape coefficient is the share of the ring around the support that the hanging specimen still
covers, seen from above: 1 for a rigid one. The specimen is simulated as a ring that the support
clamps, from nearly flat until it rests. Its folds are one of several sets that it may fall into,
and the coefficient depends on which.
"""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from r2s.environment.air import Air
from r2s.environment.contact import Table
from r2s.environment.scene import Control, Scene
from r2s.materials.fabric import Fabric
from r2s.mesh.mesh import Mesh
from r2s.solvers.implicit.cloth import Cloth

RADII = 0.15, 0.09  # of specimen and support [m]: the 30 cm templates of the standard
DEVIATION = 0.03  # of a coefficient
SHAPE = 72, 10  # vertices around, and cells from the support to the rim
LEAST = 0.01  # [m], of the support and of the ring around it
UNEVEN = 1e-3  # [m], of the start: what decides which folds come
SETTLING = 1 / 30, 80  # [s], steps
BRAKE = 3.0  # [1/s], mass damping while it settles
RESTING = 2.0, 6  # [s], steps: so long that inertia and damping hardly count
TAUGHT = 3  # of which derivatives are taken


class Ring(eqx.Module):
    """The part of a specimen that hangs, with a cell's width that the support clamps.

    - `settling`, `resting`: what simulates it, from nearly flat, and then to its rest. The vertices
      of their mesh go circle by circle, the rim's last.
    - `around`: how many a circle has. `radii`: of specimen and support, [m].
    """

    settling: Cloth
    resting: Cloth
    around: int = eqx.field(static=True)
    radii: tuple[float, float] = eqx.field(static=True)

    @property
    def mesh(self) -> Mesh:
        """Its mesh, flat."""
        return self.resting.scene.mesh


class Drape(eqx.Module):
    """A measured drape.

    - `coefficient`: the mean over specimens and sides, [-].
    - `deviation`: its standard error, [-].
    - `radii`: of specimen and support, [m].
    - `name`: for messages.
    """

    coefficient: Float[Array, ""]
    deviation: Float[Array, ""]
    radii: tuple[float, float] = eqx.field(static=True, default=RADII)
    name: str = eqx.field(static=True, default="drape")

    @classmethod
    def make(
        cls,
        coefficient: float,
        radii: tuple[float, float] = RADII,
        deviation: float = DEVIATION,
        name: str = "drape",
    ) -> "Drape":
        """From what the tester reads; see the fields.

        Raises `ValueError` that names the test: a coefficient in per cent, radii that are
        diameters or none in metres.
        """
        if not 0 < coefficient < 1:
            raise ValueError(
                f"{name}: a drape coefficient is a share from 0 to 1, got {coefficient}: "
                "is it in per cent?"
            )
        specimen, support = radii
        if not LEAST <= support <= specimen - LEAST or specimen > 0.2:
            raise ValueError(
                f"{name}: the radii [m] of specimen and support are such as {RADII}, got {radii}: "
                "are they diameters, or in centimetres?"
            )
        if not 0 < deviation < 0.5:
            raise ValueError(f"{name}: the deviation is a share such as 0.03, got {deviation}")
        value, spread = (jnp.asarray(n, float) for n in (coefficient, deviation))
        return cls(value, spread, (float(specimen), float(support)), name)

    @property
    def count(self) -> int:
        """How many data it has."""
        return 1

    def residuals(self, fabric: Fabric) -> Float[Array, " 1"]:
        """How far a fabric's coefficient is from the measured one, in standard deviations."""
        around = ring(self.radii)
        x = drape(around, fabric, jr.key(0))
        return (coefficient(around, x) - self.coefficient)[None] / self.deviation


def ring(radii: tuple[float, float] = RADII, shape: tuple[int, int] = SHAPE) -> Ring:
    """The ring of a specimen.

    - `radii`: of specimen and support, [m].
    - `shape`: vertices around, and cells from the support to the rim.
    """
    with jax.ensure_compile_time_eval():  # sizes follow from the mesh, also under `jax.jit`
        return _ring(radii, shape)


@cache
def _ring(radii: tuple[float, float], shape: tuple[int, int]) -> Ring:
    around, cells = shape
    width = (radii[0] - radii[1]) / cells
    circles = radii[1] + width * np.arange(-1, cells + 1)
    turns = 2 * np.pi * (np.arange(around) + np.arange(len(circles))[:, None] % 2 / 2) / around
    rest = circles[:, None, None] * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    mesh = Mesh.make(rest.reshape(-1, 2), _faces(around, len(circles)))
    held = jnp.arange(2 * around)
    scene = Scene(mesh, held, Table.make(-1.0), Air.make(0.0))
    settling, resting = (Cloth.make(scene, dt) for dt, _ in (SETTLING, RESTING))
    return Ring(settling, resting, around, radii)


def drape(around: Ring, fabric: Fabric, key: PRNGKeyArray) -> Float[Array, "vertex 3"]:
    """Where the vertices of a specimen rest, [m]; the support is at z = 0. NaN where it failed.

    `key`: of the unevenness that it starts with. Derivatives are those of the sheet at rest.
    """
    scene = around.resting.scene
    flat = jnp.pad(scene.mesh.rest, ((0, 0), (0, 1)))
    uneven = UNEVEN * jr.normal(key, (len(flat),), flat.dtype)
    start = flat.at[:, 2].set(jnp.where(scene.is_free, uneven, 0))
    control = Control(flat[scene.held], jnp.zeros(3, flat.dtype))

    def steps(solver: Cloth, count: int, fabric: Fabric, x: Array) -> tuple[Array, Array]:
        def step(state, _):
            return solver.step(fabric, state, control), None

        state, _ = jax.lax.scan(step, solver.init(x), length=count)
        return state.x, state.failure

    brake = jnp.full_like(fabric.mass_damping, BRAKE)
    braked = eqx.tree_at(lambda f: f.mass_damping, fabric, brake)
    x, failed = jax.lax.stop_gradient(steps(around.settling, SETTLING[1], braked, start))
    x, failed_then = jax.lax.stop_gradient(steps(around.resting, RESTING[1], fabric, x))
    x, failed_last = steps(around.resting, TAUGHT, fabric, x)
    return jnp.where(failed + failed_then + failed_last == 0, x, jnp.nan)


def coefficient(around: Ring, x: Float[Array, "vertex 3"]) -> Float[Array, ""]:
    """The drape coefficient [-] of a specimen that rests at `x` [m], from its rim's outline.

    The rim must not fold under itself, as seen from above: then it is a little low.
    """
    outline = x[-around.around :, :2]
    flat = around.mesh.rest[-around.around :]
    support = jnp.pi * around.radii[1] ** 2
    return (_area(outline) - support) / (_area(flat) - support)


def _area(outline: Float[Array, "vertex 2"]) -> Float[Array, ""]:
    ahead = jnp.roll(outline, -1, axis=0)
    return jnp.sum(outline[:, 0] * ahead[:, 1] - ahead[:, 0] * outline[:, 1]) / 2


def _faces(around: int, circles: int) -> Int[np.ndarray, "face 3"]:
    """Triangles between circles, each of which is turned by half a vertex against the last."""
    here = np.arange(around)
    ahead = (here + 1) % around
    faces = []
    for circle in range(circles - 1):
        a, b = here + circle * around, ahead + circle * around
        c, d = a + around, b + around
        pairs = [(a, c, b), (b, c, d)] if circle % 2 == 0 else [(a, d, b), (a, c, d)]
        faces += [np.stack(pair, axis=1) for pair in pairs]
    return np.concatenate(faces)
