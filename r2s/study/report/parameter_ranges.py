"""What estimates may find, what they are told, and what truths are made with: tables of numbers."""

from collections.abc import Iterable, Sequence

import jax.numpy as jnp
import numpy as np

from r2s.cloth.self_contact.detection import CLOSEST, WATCHED
from r2s.estimation.default_spaces import FROM, Law, fixed, with_law
from r2s.estimation.method import default_space
from r2s.fabrics.parameters import ParameterSpace
from r2s.study.evaluations import EvaluationCell
from r2s.study.sources import LAYERED, SyntheticRecording, TruthSettings, small_strain, true_fabric
from r2s.study.tables import MISSING, Table, significant
from r2s.world.contact import PRESSURE_STIFFNESS, SLIP_SPEED

HEADER = ("solver", "parameter", "unit", "low", "high", "middle", "truths", "from")
CAPTION = (
    "Ranges of what is estimated, and what estimates are told (one value, or one for each fabric); "
    "truths: geometric mean of the study's fabrics at small strain, where it is known. Laws that "
    "stiffen and soften are estimated where the recordings tell them: those of pulls and another "
    "motion together"
)


def range_table(cells: Iterable[EvaluationCell]) -> Table:
    """A line for each parameter of each solver, then for each number that stays as it is."""
    # what is estimated on points is predicted on the cloth, too
    cells = [c for c in cells if c.estimate is not None and c.solver == c.estimate.solver]
    lines: list[tuple[str, ...]] = []
    for solver in dict.fromkeys(cell.solver for cell in cells):
        own = [cell for cell in cells if cell.solver == solver]
        densities = list(dict.fromkeys(cell.density for cell in own))
        law = _law(own)
        lines += _ranges(
            solver, with_law(default_space(solver, densities[0]), law), law, _known(own)
        )
        lines += _fixed(solver, [default_space(solver, density) for density in densities])
    return Table(HEADER, tuple(lines), CAPTION)


def _law(cells: Sequence[EvaluationCell]) -> Law:
    """All laws that an estimate may have: both, where any is but constant."""
    laws = {cell.estimate.law for cell in cells if cell.estimate is not None}
    return "linear" if laws <= {"linear"} else "stiffening+softening"


def _known(cells: Sequence[EvaluationCell]) -> list[str]:
    """The fabrics whose truth has constant laws at small strain."""
    sources = [source for cell in cells for source in cell.recordings]
    return list(
        dict.fromkeys(
            source.fabric
            for source in sources
            if isinstance(source, SyntheticRecording) and not source.truth.materials
        )
    )


def _ranges(
    solver: str, space: ParameterSpace, law: Law, fabrics: list[str]
) -> list[tuple[str, ...]]:
    places = [np.asarray(space.to_unit(true_fabric(fabric, law))) for fabric in fabrics]
    half = jnp.full(space.dim, 0.5, float)
    middle = np.asarray(space.values(half))
    truths = (
        np.asarray(space.values(jnp.asarray(np.mean(places, axis=0), float))) if places else None
    )
    return [
        (
            solver,
            each.name,
            each.unit,
            significant(each.low),
            significant(each.high),
            significant(float(middle[i])),
            MISSING if truths is None else significant(float(truths[i])),
            FROM.get(each.name, MISSING),
        )
        for i, each in enumerate(space.ranges)
    ]


def _fixed(solver: str, spaces: list[ParameterSpace]) -> list[tuple[str, ...]]:
    found = []
    for together in zip(*map(fixed, spaces), strict=True):
        values = list(dict.fromkeys(significant(each.value) for each in together))
        one = together[0]
        told = ", ".join(values)
        found.append((solver, one.name, one.unit, told, told, told, MISSING, one.origin))
    return found


def truth_settings(truth: TruthSettings, fabrics: Iterable[str]) -> dict[str, str]:
    """Numbers of the truths, in words: of their contact with themselves and of the table's."""
    known = [small_strain(fabric) for fabric in fabrics]
    if not known:
        return {}
    thickness = sorted({1e3 * float(fabric.thickness) for fabric in known})
    friction = sorted({float(fabric.friction) for fabric in known})

    def told(values: list[float]) -> str:
        return ", ".join(significant(value) for value in values)

    contact = (
        f"from {told(thickness)} mm on, a pressure of {PRESSURE_STIFFNESS:.3g} Pa/m^2 "
        f"times the square of the depth; friction {told(friction)} by fabric, which fades below "
        f"{1e3 * SLIP_SPEED:g} mm/s"
    )
    layers = "none: a sheet passes through itself"
    if truth.self_contact:
        layers = (
            f"in folds, on {LAYERED[0]} x {LAYERED[1]} vertices at most, {contact}; places are "
            f"watched from {WATCHED:g} thicknesses on, and no step brings them nearer than "
            f"{CLOSEST:g} thicknesses"
        )
    return {"truths' contact with the table": contact, "truths' contact with themselves": layers}
