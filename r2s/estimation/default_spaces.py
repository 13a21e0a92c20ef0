"""The default parameter spaces, and the origin of their ranges and fixed values.

None is centred on a fabric that is to be estimated. The middle of a range is the start of a search
and the value of a parameter that a motion does not determine.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from r2s.materials import prior
from r2s.materials.parameters import (
    EXTENDED,
    LOSSES,
    IsotropicSpace,
    OrthotropicSpace,
    ParameterSpace,
    Range,
)
from r2s.recordings.recording import Recording

Law = str  # "linear", or names of `EXTENDED` with + between them

RANGES = (
    Range("warp", "N/m", 6.0, 20000.0),
    Range("weft", "N/m", 6.0, 20000.0),
    Range("shear", "N/m", 1.0, 800.0),
    Range("coupling", "-", -0.9, 0.9, log=False),
    Range("bending", "N m", 1.4e-7, 1.4e-3),
    *LOSSES,
)
FROM = {
    "warp": "around the prior's median",
    "weft": "around the prior's median",
    "shear": "around the prior's median",
    "coupling": "within -1 to 1, where a sheet is stable; in the middle none",
    "bending": "a factor of 100 around the prior's median at 0.2 kg/m^2",
    "damping": "around the prior's median, a factor of 18",
    "friction": "physical convention",
    "bending loss": "from none to 0.85: above 8/9 a moment would fall",
    "bending knee": "around 30 1/m, where sheets of decimetres bend; a factor of 10",
    "stiffening": "from none to 1000, locked yarns",
    "knee warp": "from 0.3 % to none that is reached",
    "knee weft": "from 0.3 % to none that is reached",
    "E h": "around 100 N/m, where the public code of DiffCP starts; longer would be shorter steps",
    "nu": "isotropic solids, 0 to 0.5",
    **{name: words for space in EXTENDED.values() for name, words in space.origins.items()},
}
"""Of each range: what it is around. The prior is `r2s.materials.prior`."""


def with_law(space: ParameterSpace, law: Law) -> ParameterSpace:
    """A space of constant stiffness, with the numbers of a law besides. Raises `ValueError` for one
    that is not known."""
    names = [] if law == "linear" else law.split("+")
    if unknown := [name for name in names if name not in EXTENDED]:
        known = ", ".join(("linear", *EXTENDED))
        raise ValueError(f"no law {unknown[0]!r}; there are {known}, and several with +")
    for name in reversed(EXTENDED):
        space = EXTENDED[name].make(space) if name in names else space
    return space


def identified_law(recordings: Sequence[Recording]) -> Law:
    """The law that some recordings of one fabric identify: stiffening and softening from another
    motion and a pull with its force, since a pull determines how yarns stiffen and a fold bending.
    Else constant stiffness."""
    pulls = [recording for recording in recordings if recording.info.scenario == "stretching"]
    has_force = any(pull.force is not None for pull in pulls)
    return "stiffening+softening" if has_force and len(pulls) < len(recordings) else "linear"


def law_of(ranges: Sequence[Range]) -> Law:
    """The law of a space's parameters, or of an estimate's, by their names."""
    names = {bound.name for bound in ranges}
    laws = [law for law, space in EXTENDED.items() if space.extra[0].name in names]
    return "+".join(laws) or "linear"


class Fixed(NamedTuple):
    """A number that is not estimated: its name, unit [-], value and where that is from."""

    name: str
    unit: str
    value: float
    origin: str


def on_cloth(density: float) -> OrthotropicSpace:
    """Orthotropic fabrics of an areal density, [kg/m^2]; raises as `OrthotropicSpace.make`."""
    space = OrthotropicSpace.make(density, prior.THICKNESS)
    return OrthotropicSpace(density=space.density, thickness=space.thickness, ranges=RANGES)


def on_mpm(density: float, losses: tuple[Range, ...] = ()) -> IsotropicSpace:
    """Isotropic sheets of an areal density, [kg/m^2]; raises as `IsotropicSpace.make`.

    Damping and friction are the prior's median, or parameters (`losses`). The sheet in the middle
    of the range bends as that of the prior, others as plates of the same thickness.
    """
    usual = IsotropicSpace.make(density)
    assumed, middle = prior.middle(density), usual.middle()
    stiffer = float(middle.bending.stiffness) / float(assumed.bending.stiffness)
    return IsotropicSpace.make(
        density,
        plate=float(usual.plate) / math.sqrt(stiffer),
        damping=float(assumed.damping),
        friction=float(assumed.friction),
        thickness=prior.THICKNESS,
        losses=losses,
    )


def fixed(space: ParameterSpace) -> tuple[Fixed, ...]:
    """What a space of this module does not estimate; raises `TypeError` for another one."""
    if not isinstance(space, OrthotropicSpace | IsotropicSpace):
        raise TypeError(f"a default space is orthotropic or isotropic, got {type(space).__name__}")
    middle = space.middle()
    shared = [
        Fixed("density", "kg/m^2", float(space.density), "weighed"),
        Fixed("thickness of contact", "m", float(space.thickness), "convention"),
        Fixed("mass damping", "1/s", float(middle.mass_damping), "none: the air brakes"),
    ]
    if isinstance(space, OrthotropicSpace):
        ratio = float(middle.bending.poissons_ratio)
        return (*shared, Fixed("Poisson's ratio of bending", "-", ratio, "convention"))
    plate = "bends as the prior's median of such a weight, in the middle of the range"
    losses = (
        Fixed("damping", "s", float(space.damping), "the prior's median"),
        Fixed("friction", "-", float(space.friction), "the prior's median"),
    )
    estimated = {bound.name for bound in space.ranges}
    return (
        *shared,
        Fixed("plate thickness", "m", float(space.plate), plate),
        *(loss for loss in losses if loss.name not in estimated),
        Fixed("anisotropy", "-", 0.0, "the space has none"),
    )
