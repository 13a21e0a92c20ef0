"""A strip held at one end, under its own weight: how it bends down, and how it buckles sideways.

Bent down it is the heavy elastica, and the cantilever test that measures fabrics' stiffness. On its
edge it buckles as a beam does that is deep and narrow.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import cloth, flat, roll, strip
from elastica import elastica
from scipy.linalg import eigh

from r2s._util.units import GRAVITY
from r2s.materials.bending import HingeBending
from r2s.materials.fabric import Fabric
from r2s.materials.membrane import OrthotropicMembrane
from r2s.materials.plate import OrthotropicPlate, PlateBending

LENGTH = 0.2  # [m], with the held cell
DENSITY = 0.2  # [kg/m^2]
LONG = 5.0  # [s]: in a step as long as this, inertia and damping hardly count
STEPS = 12
MEMBRANE = (1e4, 0.0, 1e4, 5e3)  # C11, C12, C22, C33 [N/m]: strains are below 1e-4


def clamped_at(elements: str) -> float:
    """Where a strip whose first two rows are held is clamped, in cells from its end.

    A hinge stands for half a cell on either side, and so does the first, at the end of the held
    cell: the strip is clamped in the middle of that cell. The first turn of a line of vertices
    stands for the next half cell, too, and yields as two thirds of a cell do.
    """
    return 5 / 6 if elements == "quadrilaterals" else 1 / 2


def free_length(cells: int, elements: str = "quadrilaterals") -> float:
    """Length [m] that bends."""
    return LENGTH * (1 - clamped_at(elements) / cells)


def stiffness(cells: int, number: float, elements: str = "quadrilaterals") -> float:
    """Bending stiffness [N m] of a strip with this number."""
    return DENSITY * GRAVITY * free_length(cells, elements) ** 3 / number


def bending(along: float, across: float, axis: int) -> OrthotropicPlate:
    """The law of a strip along warp (0) or weft (1)."""
    warp, weft = (along, across) if axis == 0 else (across, along)
    return OrthotropicPlate(*(jnp.asarray(b, float) for b in (warp, (warp + weft) / 2, weft)))


def rest(mesh, along, law, start):
    """Where a strip comes to rest [m] whose first two rows are held; `along` it [m] from there."""

    def array(value):
        return jnp.asarray(value, float)

    membrane = OrthotropicMembrane(*map(array, MEMBRANE))
    numbers = map(array, (0.05, 0.0, 1e-3, 0.0))  # damping, friction, thickness, mass damping
    fabric = Fabric(array(DENSITY), membrane, law, *numbers)
    held = np.flatnonzero(along < 1.5 * np.min(along[along > 0]))
    # to buckle within one step takes many iterations
    solver = dataclasses.replace(cloth(mesh, held, dt=LONG), max_iterations=2000)
    x = roll(solver, fabric, solver.init(start), STEPS).x
    assert np.max(np.abs(x[-1] - x[-2])) < 1e-6
    return x[-1]


def tip(cells: int, axis: int, law, elements: str):
    """Where the tip of a strip comes to rest [free length], from the clamp: ahead and down."""
    cell = LENGTH / cells
    mesh = strip(axis, (LENGTH, 2 * cell), (cells, 2), elements)
    along = np.asarray(mesh.rest[:, axis])
    end = rest(mesh, along, law, flat(mesh))[along > LENGTH - cell / 2].mean(axis=0)
    held = clamped_at(elements) * cell
    return np.array([end[axis] - held, -end[2]]) / free_length(cells, elements)


def miss(cells: int, axis: int, number: float, elements: str = "quadrilaterals") -> float:
    """How far [free length] the tip of a strip, three times as stiff along as across, is from the
    elastica's."""
    along = stiffness(cells, number, elements)
    found = tip(cells, axis, bending(along, along / 3, axis), elements)
    return float(np.linalg.norm(found - elastica(number)))


NUMBERS = [1.0, 3.0, 10.0, 30.0]


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("elements", ["quadrilaterals", "falling"])
@pytest.mark.parametrize("axis", [0, 1], ids=["warp", "weft"])
@pytest.mark.parametrize("number", NUMBERS)
def test_the_tip_of_a_strip_hangs_where_the_elastica_does(number, axis, elements):
    assert miss(16, axis, number, elements) < 0.004


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("elements", ["quadrilaterals", "falling"])
@pytest.mark.parametrize("number", [1.0, 10.0])
def test_the_tip_converges_to_the_elastica_to_second_order(number, elements):
    coarse, medium, fine = (miss(cells, 0, number, elements) for cells in (8, 16, 32))
    assert 2**1.7 < coarse / medium < 2**2.4 and 2**1.7 < medium / fine < 2**2.4


def heights_matrix(cells: int, law, across: int = 2, elements: str = "quadrilaterals"):
    """A strip, and the second derivative [N/m] of its bending energy in the heights, when flat."""
    mesh = strip(0, (LENGTH, across * LENGTH / cells), (cells, across), elements)

    def raised(height):
        return jnp.concatenate([mesh.rest, height[:, None]], axis=1)

    def curvature(height):
        return law.bends(mesh).curvatures_at(raised(height))

    at_rest = jnp.zeros(mesh.rest.shape[0])
    if law.element == "plate":
        laws = jax.vmap(law.at)(law.curvatures(mesh, curvature(at_rest)))
    else:
        laws = jax.vmap(law.at)(mesh.hinge_direction, curvature(at_rest))

    def energy(height):
        bent = laws.curvatures(mesh, curvature(height))
        densities = jax.vmap(lambda law, bent: law.energy_density(bent))(laws, bent)
        return jnp.sum(laws.areas(mesh) * densities)

    return mesh, np.asarray(jax.jit(jax.hessian(energy))(at_rest))


def small_stiffness(cells: int, law, across: int = 2, elements: str = "quadrilaterals") -> float:
    """Bending stiffness [N m] of a strip that deflects little, from the sag of its tip."""
    mesh, matrix = heights_matrix(cells, law, across, elements)
    free = slice(2 * (across + 1), None)  # two rows are held
    heights = np.linalg.solve(matrix[free, free], np.asarray(mesh.vertex_area)[free])
    sag = heights[-(across + 1) :].mean()
    return free_length(cells, elements) ** 4 / (8 * sag)


def in_the_limit(value, law, elements: str = "quadrilaterals") -> float:
    # Richardson: next to the clamp the rows are straight, an error of first order
    coarse, fine = (value(cells, law, elements=elements) for cells in (16, 32))
    return 2 * fine - coarse


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("elements", ["falling", "rising", "quadrilaterals"])
def test_a_thin_strip_of_plate_has_its_stiffness(elements):
    found = in_the_limit(small_stiffness, PlateBending.make(1.0), elements)
    assert found == pytest.approx(1, rel=2e-3)


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("ratio", [-0.3, 0.3])
def test_a_strip_of_plate_is_free_to_curve_across(ratio):
    # but for the faces at its border, which do not see how they should curve across
    law = PlateBending.make(1.0, ratio)
    narrow, wide = (in_the_limit(partial(small_stiffness, across=n), law) for n in (2, 4))
    assert 2 * wide - narrow == pytest.approx(1 - ratio**2, rel=0.01)


HINGES = HingeBending(jnp.ones((), float))


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("elements", ["falling", "alternating"])
def test_hinges_along_a_thin_strip_act_in_series_with_its_diagonals(elements):
    # Where the diagonals are parallel, the strip twists as it bends; where they alternate, the
    # hinges across each column see only every other vertex of it, so that columns bend in turn.
    found = in_the_limit(small_stiffness, HINGES, elements)
    assert found == pytest.approx(1 / (1 + 1 / 4), rel=0.01)


# On its edge


def prestress(mesh, free):
    """Second derivative [N/m] of the membrane energy in the heights of a strip on its edge.

    That is what the stress of its weight, which is in its plane, adds to the stiffness across it.
    """
    count = mesh.rest.shape[0]

    def grown(moved):
        return mesh.samples.strains(jnp.pad(mesh.rest + moved, ((0, 0), (0, 1))))

    strain = np.asarray(jax.jit(jax.jacfwd(grown))(jnp.zeros((count, 2)))).reshape(-1, 3, 2 * count)
    c11, c12, c22, c33 = MEMBRANE
    law = np.array([[c11, c12, 0], [c12, c22, 0], [0, 0, c33]])
    area = np.asarray(mesh.samples.areas).ravel()
    stiffness = np.einsum("fsa,f,st,ftb->ab", strain, area, law, strain, optimize=True)
    weight = np.asarray(mesh.vertex_area)[:, None] * [0, -DENSITY * GRAVITY]
    both = np.repeat(free, 2)
    moved = np.zeros(2 * count)
    moved[both] = np.linalg.solve(stiffness[np.ix_(both, both)], weight.ravel()[both])
    stress = strain @ moved @ law
    tensor = stress[:, [[0, 2], [2, 1]]]
    slope = np.zeros((len(area), 2, count))  # of the heights, in a face
    samples = mesh.samples
    gradients = np.asarray(samples.gradients).reshape(len(area), -1, 2).transpose(0, 2, 1)
    corners = np.repeat(np.asarray(samples.corners), samples.areas.shape[1], axis=0)
    np.put_along_axis(slope, corners[:, None], gradients, axis=2)
    return np.einsum("fsa,f,fst,ftb->ab", slope, area, tensor, slope, optimize=True)


def critical_number(cells: int, law, across: int = 2, elements: str = "quadrilaterals") -> float:
    """The number (see `elastica`) at which a strip on its edge first buckles sideways."""
    mesh, matrix = heights_matrix(cells, law, across, elements)
    free = np.arange(mesh.rest.shape[0]) >= 2 * (across + 1)
    inner = np.ix_(free, free)
    stiffest = eigh(-prestress(mesh, free)[inner], matrix[inner], eigvals_only=True)[-1]
    return DENSITY * GRAVITY * free_length(cells, elements) ** 3 / stiffest


def buckling(bends: float, twists: float) -> float:
    """The critical number of a beam of these rigidities over the width, [N m] of stiffness 1.

    Michell and Prandtl: weight per length = 12.85 sqrt(bending x torsional rigidity) / length^3.
    """
    return 12.85 * (bends * twists) ** 0.5


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("ratio", [0.0, 0.3])
def test_a_strip_on_its_edge_buckles_at_prandtls_weight(ratio):
    law = PlateBending.make(1.0, ratio)
    wide, narrow = critical_number(32, law), critical_number(64, law)  # two cells, in both
    expected = buckling(1 - ratio**2, 2 * (1 - ratio))
    # Richardson again, in the width, a sixteenth of the length: finer cells alone leave 4 %
    assert 2 * narrow - wide == pytest.approx(expected, rel=0.005)
