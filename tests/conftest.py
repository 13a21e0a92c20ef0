"""What the tests share: strict float64, compiled programs, a small sheet, and a step compiled once.

Most tests use the 5 x 5 `sheet` and the step `DT`, so that they share two compilations of `step`:
a sheet that is free, and one held by its first row. Compiled programs are also kept in files, for
the other process, for processes that tests start, and for the next run; and they are let go when a
process holds too much.
"""

import gc
import os
import resource
import sys
from collections.abc import Iterator

import equinox as eqx
import hypothesis
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import psutil
import pytest

from r2s._util.units import GRAVITY
from r2s.compilation import clear
from r2s.environment.scene import Control, Scene
from r2s.materials.fabric import Fabric
from r2s.mesh.mesh import Mesh, rectangle
from r2s.mesh.strain_samples import on_samples
from r2s.mesh.surface import vertex_masses
from r2s.solvers.implicit.cloth import ImplicitCloth, ImplicitState
from r2s.solvers.implicit.system import Pattern

# Of the tests that take more than a second or two, up to minutes.
SLOW_GROUPS = (
    "cloth",
    "mpm",
    "motions",
    "estimates",
    "arrival",
    "pinn",
    "physnet",
    "study",
    "verdicts",
    "documents",
)
# Files that take longest. They come first, so that no process ends long after the other.
LONG = ("test_estimators", "test_study", "test_contract", "test_pinn_estimate", "test_cloth")
MOST_MEMORY = 1000  # [MB]: a process that holds more lets its compiled programs go
# Tracing makes many objects that stay: to count them again and again took a quarter of its time.
gc.set_threshold(100_000, 50, 100)

jax.config.update("jax_enable_x64", True)
hypothesis.settings.register_profile("r2s", deadline=None)  # a first example compiles
hypothesis.settings.load_profile("r2s")
few = hypothesis.settings(max_examples=25)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


def pytest_configure(config: pytest.Config) -> None:
    """Keep compiled programs in `.pytest_cache`, unless the environment names another folder."""
    if hasattr(config, "cache"):
        folder = str(config.cache.mkdir("jax"))
        keep_programs(os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", folder))


def keep_programs(folder: str) -> None:
    """Compiled programs are written to a folder and read from it; a damaged file is compiled."""
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest files; refuse a slow test of no group, which no command would run."""
    items.sort(key=lambda item: item.path.stem not in LONG)
    for item in items:
        slow = item.get_closest_marker("slow")
        if slow is not None and slow.kwargs.get("group") not in SLOW_GROUPS:
            raise pytest.UsageError(f"{item.nodeid}: slow needs a group of {SLOW_GROUPS}")


@pytest.fixture(autouse=True, scope="module")
def little_memory() -> Iterator[None]:
    """After a module, compiled programs are let go if the process holds much memory."""
    yield
    let_go_beyond(MOST_MEMORY)


@pytest.fixture(autouse=True)
def little_memory_within_a_module() -> Iterator[None]:
    """After a test, if the process holds far too much."""
    yield
    let_go_beyond(2.5 * MOST_MEMORY)


def let_go_beyond(memory_in_use: float) -> None:
    """Let compiled programs go if the process holds more memory [MB]."""
    if memory() > memory_in_use:
        clear()


def memory() -> float:
    """Resident memory of this process [MB]."""
    return psutil.Process().memory_info().rss / 1e6


def most_memory() -> float:
    """The most resident memory that this process had [MB]."""
    unit = 1 if sys.platform == "darwin" else 1024  # [byte]
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


MOST_OF_EACH: list[float] = []  # processes that ran tests [MB]


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Tell the process that collects the results how much memory this one took."""
    getattr(session.config, "workeroutput", {})["most_memory"] = most_memory()


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node) -> None:
    MOST_OF_EACH.append(getattr(node, "workeroutput", {}).get("most_memory", float("nan")))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    most = ", ".join(f"{each:.0f}" for each in MOST_OF_EACH or [most_memory()])
    terminalreporter.write_line(f"Most memory of each process: {most} MB")


SIZE = 0.2  # of the sheet's sides, [m]
SHAPE = (5, 5)
FIRST_ROW = range(5)  # the vertices at warp = 0
DT = 0.01  # [s]


@pytest.fixture(scope="session")
def sheet() -> Mesh:
    """A square of 0.2 m with 5 x 5 vertices."""
    return rectangle((SIZE, SIZE), SHAPE)


@pytest.fixture(scope="session")
def fabric() -> Fabric:
    return Fabric.make(0.2, (300.0, 60.0, 200.0, 80.0), 2e-5)


@pytest.fixture
def unchecked():
    """The shape checks of the tests off, so that the code's own are reached."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def cloth(
    mesh: Mesh, pinned=(), table: float | None = None, air: float | None = None, dt: float = DT
) -> ImplicitCloth:
    """A solver for a sheet; by default free, without table, in vacuum."""
    return ImplicitCloth(Scene(mesh, tuple(pinned), table, air), dt)


def flat(mesh: Mesh, height: float = 0.0):
    """Positions of a flat, horizontal sheet at a height [m]."""
    return mesh.lay_flat(height)


def rotation(angle: float, axis: int):
    """A rotation matrix about a world axis."""
    i, j = [k for k in range(3) if k != axis]
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.eye(3).at[i, i].set(c).at[j, j].set(c).at[i, j].set(-s).at[j, i].set(s)


def strip(axis: int, size: tuple[float, float], cells: tuple[int, int], elements="wrinkling"):
    """A strip along warp (0) or weft (1); its size [m] and cells along it and across it."""
    (length, width), (along, across) = size, cells
    if axis == 0:
        return rectangle((length, width), (along + 1, across + 1), elements)
    return rectangle((width, length), (across + 1, along + 1), elements)


def stretch_under(tension: float, modulus: float) -> float:
    """The stretch s [-] at which a strip has a tension [N/m] of modulus s (s^2 - 1) / 2."""
    return np.roots([modulus / 2, 0, -modulus / 2, -tension]).real.max()


def two_of(mesh: Mesh) -> Mesh:
    """Two copies of a sheet that do not touch."""
    rest, faces = np.asarray(mesh.rest), np.asarray(mesh.faces)
    both = np.concatenate([rest, rest + [2.0, 0.0]])
    return Mesh.make(both, np.concatenate([faces, faces + len(rest)]))


def hanging(mesh: Mesh, angle: float = 0.0):
    """Positions of a flat sheet that hangs from its first row, swung out by an angle."""
    return flat(mesh) @ rotation(angle - np.pi / 2, 1).T


def everywhere(vector, mesh: Mesh):
    """The same vector at every vertex."""
    return jnp.broadcast_to(jnp.asarray(vector, float), (mesh.rest.shape[0], 3))


@eqx.filter_jit
def step(
    solver: ImplicitCloth, fabric: Fabric, state: ImplicitState, control: Control
) -> ImplicitState:
    return solver.step(fabric, state, control)


def roll(
    solver: ImplicitCloth,
    fabric: Fabric,
    state: ImplicitState,
    count: int,
    path=None,
    wind=(0, 0, 0),
):
    """The states from `state` on, after each of `count` steps, as numpy arrays (time, vertex, 3).

    `path` gives the pinned vertices' positions at a time [s] from the start; by default they stay.
    """
    states, start = [state], state.x[solver.scene.pinned]
    for i in range(1, count + 1):
        pinned = start if path is None else path(i * solver.dt)
        states.append(step(solver, fabric, states[-1], Control(pinned, jnp.asarray(wind, float))))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *states)


@eqx.filter_jit
def stored_energy(mesh: Mesh, fabric: Fabric, x):
    """Energy [J] in the strains and curvatures of a sheet."""
    membrane = on_samples(fabric.membrane.energy_density, mesh.samples.strains(x))
    bent = fabric.bending.bends(mesh).curvatures_at(x)
    bending = jax.vmap(fabric.bending.energy_density)(fabric.bending.curvatures(mesh, bent))
    return jnp.sum(mesh.samples.areas * membrane) + jnp.sum(fabric.bending.areas(mesh) * bending)


@eqx.filter_jit
def energy(mesh: Mesh, fabric: Fabric, x, v):
    """Stored, kinetic and gravitational energy [J] of a sheet."""
    mass = vertex_masses(mesh, fabric.density)
    motion = jnp.sum(mass * (jnp.sum(v**2, axis=1) / 2 + GRAVITY * x[:, 2]))
    return stored_energy(mesh, fabric, x) + motion


def directional_difference(function, at, direction, size: float):
    """The central difference of `function` at a tree of arrays along another."""

    def moved(sign):
        return jax.tree.map(lambda a, d: a + sign * size * d, at, direction)

    return (function(moved(1)) - function(moved(-1))) / (2 * size)


def assert_gradient(value, gradient, at, where, size: float, rel: float):
    """A gradient agrees with central differences of a value, in one direction of a part of inputs.

    `where` names the part, which is differed by a `size`.
    """
    part = where(at)
    direction = jax.random.normal(jax.random.key(2), part.shape)
    difference = directional_difference(
        lambda part: value(eqx.tree_at(where, at, part)), part, direction, size
    )
    found = jnp.sum(where(gradient) * direction)
    assert found == pytest.approx(float(difference), rel=rel)
    assert abs(found) > 1e-12  # so the value does depend on it


def dense(pattern: Pattern, blocks: jax.Array) -> jax.Array:
    """The matrix with all its zeros, coordinates ordered (vertex, axis)."""
    count = pattern.diagonal.shape[0]
    matrix = jnp.zeros((count, 3, count, 3), blocks.dtype)
    matrix = matrix.at[pattern.rows, :, pattern.columns, :].set(blocks)
    return matrix.reshape(3 * count, 3 * count)
