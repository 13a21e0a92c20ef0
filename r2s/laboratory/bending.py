"""Laboratory tests of bending: the overhang of a cantilever, and the drape of a disc.

**Cantilever** (ASTM D1388, option A; Peirce 1930). A strip is slid over an edge until the line from
the edge to its tip falls by 41.5 degrees. The shape is that of a heavy elastica, B psi'' = -density
g s cos(psi), s from the tip, so that the overhang is (B / (density g))^(1/3) times a number, which
is solved for. The standard takes half the overhang for the bending length, right to 0.02 %. A strip
is taken to bend as a cylinder, without curving across.

**Drape** (Cusick; BS EN ISO 9073-9). A disc of fabric hangs over a smaller one. The drape
coefficient is the share of the ring around the support that the specimen still covers, seen from
above: 1 for a rigid one. The specimen is simulated as a ring that the support clamps, from nearly
flat until it rests. The coefficient depends on which of several sets of folds it falls into.
"""

from collections.abc import Sequence
from functools import cache
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray
from scipy.integrate import solve_ivp
from scipy.optimize import root_scalar

from r2s._util.checks import expect
from r2s._util.units import GRAVITY
from r2s.environment.scene import Control, Scene
from r2s.materials.fabric import Fabric
from r2s.mesh.mesh import Mesh
from r2s.solvers.implicit.cloth import ImplicitCloth

SLOPE = np.radians(41.5)  # of the standard's plane [rad]
OVERHANG_DEVIATION = 0.03  # relative
RADII = 0.15, 0.09  # of specimen and support [m]: the 30 cm templates of the standard
DRAPE_DEVIATION = 0.03  # of a coefficient
RING_SHAPE = 72, 10  # vertices around, and cells from the support to the rim
SMALLEST = 0.01  # [m], of the support and of the ring around it
UNEVENNESS = 1e-3  # [m], of the start: what decides which folds come
SETTLING = 1 / 30, 80  # [s], steps
SETTLING_DAMPING = 3.0  # [1/s], mass damping while it settles
RESTING = 2.0, 6  # [s], steps: so long that inertia and damping hardly count
DIFFERENTIATED = 3  # steps


class Cantilever(eqx.Module):
    """Overhangs of strips of one direction.

    - `overhang`: mean over strips, sides and ends, [m].
    - `deviation`: standard error of the logarithm of that mean, [-].
    - `direction`: of the strip, from the warp, [rad]: 0, pi/2, or pi/4 for the bias.
    - `name`: for messages.
    """

    overhang: Float[Array, ""]
    deviation: Float[Array, ""]
    direction: float = eqx.field(static=True, default=0.0)
    name: str = eqx.field(static=True, default="cantilever")

    @classmethod
    def make(
        cls, overhangs: Sequence[float], direction: float = 0.0, name: str = "cantilever"
    ) -> "Cantilever":
        """From readings [m], whose mean errs by `OVERHANG_DEVIATION` or by their scatter.

        Raises `ValueError` that names the test for no reading, for one that is none in metres, and
        for readings that differ by more than a factor of two.
        """
        read = np.asarray(overhangs, float)
        is_length = read.ndim == 1 and read.size > 0 and ((read > 0.005) & (read < 0.5)).all()
        given = f"{name}: overhangs of fabrics are 0.005 to 0.5 m, got {read.tolist()}"
        expect(is_length, f"{given}: are they in centimetres, or bending lengths?")
        is_one = read.max() < 2 * read.min()
        expect(is_one, f"{name}: overhangs of one direction do not differ so: {read.tolist()} m")
        scatter = np.std(np.log(read), ddof=1) / np.sqrt(len(read)) if len(read) > 1 else 0.0
        deviation = max(float(scatter), OVERHANG_DEVIATION)
        mean = float(np.exp(np.mean(np.log(read))))
        return cls(jnp.asarray(mean, float), jnp.asarray(deviation, float), direction, name)

    count: ClassVar[int] = 1  # of data

    def residuals(self, fabric: Fabric) -> Float[Array, " 1"]:
        """The fabric's overhang less the measured one, in standard deviations."""
        expected = overhang(fabric, self.direction)
        return jnp.log(expected / self.overhang)[None] / self.deviation


def overhang(fabric: Fabric, direction: float = 0.0, slope: float = SLOPE) -> Float[Array, ""]:
    """The overhang [m] at which a strip's tip has fallen by a slope [rad].

    `direction`: of the strip from the warp, [rad]. Of a law whose stiffness follows the curvature
    it takes that of the flat sheet.

    >>> from r2s.materials import presets
    >>> round(float(100 * overhang(presets.black_denim())), 1)  # [cm]
    3.6
    """
    stiffness = fabric.bending.stiffness_along(direction)
    return _elastica(float(slope)) * (stiffness / (fabric.density * GRAVITY)) ** (1 / 3)


@cache
def _elastica(slope: float) -> float:
    """The overhang in units of (B / (density g))^(1/3), [-]."""

    def rates(s, state):
        psi, bent = state[:2]
        return [bent, -s * np.cos(psi), np.cos(psi), np.sin(psi)]

    def clamped(s, state):
        return state[0]

    clamped.terminal = True  # pyright: ignore[reportFunctionMemberAccess]

    def shape(tip: float) -> tuple[float, float]:
        """Length [-] and slope of the chord [rad] of a strip whose tip has a slope [rad]."""
        start = [tip, 0.0, 0.0, 0.0]
        strip = solve_ivp(rates, (0, 100), start, events=clamped, rtol=1e-9, atol=1e-12)
        _, _, run, drop = strip.y[:, -1]
        return float(strip.t[-1]), float(np.arctan2(drop, run))

    bracket = 1e-3, np.pi / 2 - 1e-3
    tip = root_scalar(lambda tip: shape(float(tip))[1] - slope, bracket=bracket).root
    return shape(float(tip))[0]


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
        deviation: float = DRAPE_DEVIATION,
        name: str = "drape",
    ) -> "Drape":
        """Raises `ValueError` that names the test for a coefficient in per cent, and for radii that
        are diameters or none in metres."""
        is_share = 0 < coefficient < 1
        expect(is_share, f"{name}: a coefficient is 0 to 1, got {coefficient}: is it in per cent?")
        specimen, support = radii
        is_ring = SMALLEST <= support <= specimen - SMALLEST and specimen <= 0.2
        given = f"{name}: the radii of specimen and support are such as {RADII} m, got {radii}"
        expect(is_ring, f"{given}: are they diameters, or in centimetres?")
        is_error = 0 < deviation < 0.5
        expect(is_error, f"{name}: the deviation is a share such as 0.03, got {deviation}")
        mean, error = (jnp.asarray(n, float) for n in (coefficient, deviation))
        return cls(mean, error, (float(specimen), float(support)), name)

    count: ClassVar[int] = 1  # of data

    def residuals(self, fabric: Fabric) -> Float[Array, " 1"]:
        """The fabric's coefficient less the measured one, in standard deviations."""
        specimen = ring(self.radii)
        x = drape(specimen, fabric, jr.key(0))
        return (coefficient(specimen, x) - self.coefficient)[None] / self.deviation


class Ring(eqx.Module):
    """The part of a specimen that hangs, with a cell's width that the support clamps.

    - `settling`, `resting`: what simulates it, from nearly flat, and then to its rest. The vertices
      of their mesh go circle by circle, the rim's last.
    - `num_around`: vertices of a circle. `radii`: of specimen and support, [m].
    """

    settling: ImplicitCloth
    resting: ImplicitCloth
    num_around: int = eqx.field(static=True)
    radii: tuple[float, float] = eqx.field(static=True)


@cache
def ring(radii: tuple[float, float] = RADII, shape: tuple[int, int] = RING_SHAPE) -> Ring:
    """The ring of a specimen, with `shape` vertices around and cells from the support to the rim.

    `radii`: of specimen and support, [m]. Each circle is turned by half a vertex against the last.
    """
    num_around, cells = shape
    width = (radii[0] - radii[1]) / cells
    circles = radii[1] + width * np.arange(-1, cells + 1)
    half = np.arange(len(circles))[:, None] % 2 / 2
    turns = 2 * np.pi * (np.arange(num_around) + half) / num_around
    rest = circles[:, None, None] * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    faces = [_faces_between(circle, num_around) for circle in range(len(circles) - 1)]
    with jax.ensure_compile_time_eval():  # sizes follow from the mesh, also under `jax.jit`
        mesh = Mesh.make(rest.reshape(-1, 2), np.concatenate(faces))
        scene = Scene(mesh, range(2 * num_around), air=None)
        settling, resting = (ImplicitCloth(scene, dt) for dt, _ in (SETTLING, RESTING))
    return Ring(settling, resting, num_around, radii)


def _faces_between(circle: int, num_around: int) -> Int[np.ndarray, "face 3"]:
    """Triangles between a circle and the next one."""
    a = np.arange(num_around) + circle * num_around
    b = np.roll(a, -1)
    c, d = a + num_around, b + num_around
    corners = [(a, c, b), (b, c, d)] if circle % 2 == 0 else [(a, d, b), (a, c, d)]
    return np.concatenate([np.stack(each, axis=1) for each in corners])


def drape(specimen: Ring, fabric: Fabric, key: PRNGKeyArray) -> Float[Array, "vertex 3"]:
    """Where the vertices of a specimen rest, [m]; the support is at z = 0. NaN where it failed.

    `key`: of the unevenness that it starts with. Derivatives are those of the sheet at rest.
    """
    scene = specimen.resting.scene
    flat = scene.mesh.lay_flat()
    uneven = UNEVENNESS * jr.normal(key, (len(flat),), flat.dtype)
    start = flat.at[:, 2].set(jnp.where(scene.is_free, uneven, 0))
    control = Control(flat[scene.pinned])

    def steps(solver: ImplicitCloth, count: int, fabric: Fabric, x: Array) -> tuple[Array, Array]:
        def step(state, _):
            return solver.step(fabric, state, control), None

        state, _ = jax.lax.scan(step, solver.init(x), length=count)
        return state.x, state.failure

    damping = jnp.full_like(fabric.mass_damping, SETTLING_DAMPING)
    damped = eqx.tree_at(lambda f: f.mass_damping, fabric, damping)
    x, failed = jax.lax.stop_gradient(steps(specimen.settling, SETTLING[1], damped, start))
    x, failed_then = jax.lax.stop_gradient(steps(specimen.resting, RESTING[1], fabric, x))
    x, failed_last = steps(specimen.resting, DIFFERENTIATED, fabric, x)
    return jnp.where(failed + failed_then + failed_last == 0, x, jnp.nan)


def coefficient(specimen: Ring, x: Float[Array, "vertex 3"]) -> Float[Array, ""]:
    """The drape coefficient [-] of a specimen that rests at `x` [m], from its rim's outline.

    The rim must not fold under itself, as seen from above: then it is a little low.
    """

    def area(outline: Float[Array, "vertex 2"]) -> Float[Array, ""]:
        ahead = jnp.roll(outline, -1, axis=0)
        return jnp.sum(outline[:, 0] * ahead[:, 1] - ahead[:, 0] * outline[:, 1]) / 2

    flat = specimen.resting.scene.mesh.rest[-specimen.num_around :]
    support = jnp.pi * specimen.radii[1] ** 2
    return (area(x[-specimen.num_around :, :2]) - support) / (area(flat) - support)
