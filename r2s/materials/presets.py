"""Fabrics with provenance.

The five fabrics of the study, with the areal density and the small-strain stiffness that Wang,
O'Brien and Ramamoorthi measured ("Data-driven elastic models for cloth: modeling and measurement",
ACM Transactions on Graphics 30(4), 2011), rounded to two digits. C33 is half of theirs, since ours
acts on the engineering shear strain. Bending is a quarter of the mean over their directions and
curvatures, since the moment of their hinges is k l^2 / (4 A) per angle, that of a plate l^2 / A
times its stiffness. Damping and friction were not measured there: they are r2s's defaults.

`MEASURED` has four more of the ten fabrics of that paper. The tenth, navy sparkle sweat, has a C12
whose square is above C11 C22, which no sheet of constant stiffness has.
"""

from r2s.materials.fabric import Fabric


def camel_ponte_roma() -> Fabric:
    """A double knit. Wang et al. 2011."""
    return Fabric.make(0.28, (31.0, -13.0, 44.0, 16.0), 8.3e-6)


def black_denim() -> Fabric:
    """An 11 oz twill. Wang et al. 2011."""
    return Fabric.make(0.32, (210.0, 10.0, 1000.0, 27.0), 1.8e-5)


def grey_interlock() -> Fabric:
    """A T-shirt knit. Wang et al. 2011."""
    return Fabric.make(0.19, (17.0, -15.0, 34.0, 18.0), 5.5e-6)


def pink_solid() -> Fabric:
    """The ribbon brown of Wang et al. 2011, which the study calls pink solid."""
    return Fabric.make(0.23, (150.0, 110.0, 240.0, 15.0), 2.8e-5)


def red_jet_set() -> Fabric:
    """A light knit. Wang et al. 2011."""
    return Fabric.make(0.11, (43.0, 54.0, 170.0, 7.2), 4.8e-6)


def ivory_rib_knit() -> Fabric:
    """A rib knit of 95 % cotton and 5 % spandex, as of underwear. Wang et al. 2011."""
    return Fabric.make(0.28, (43.0, -0.23, 65.0, 42.0), 1.2e-5)


def white_dots_on_black() -> Fabric:
    """A polyester, as of tablecloths. Wang et al. 2011."""
    return Fabric.make(0.13, (2000.0, 0.35, 2000.0, 9.6), 7.8e-6)


def white_swim_solid() -> Fabric:
    """87 % nylon and 13 % spandex, as of swimsuits. Wang et al. 2011."""
    return Fabric.make(0.20, (48.0, 6.8, 100.0, 30.0), 1.3e-5)


def royal_target() -> Fabric:
    """65 % cotton and 35 % polyester, as of trousers. Wang et al. 2011."""
    return Fabric.make(0.22, (2000.0, 9.2, 2000.0, 52.0), 4.3e-5)


_STUDY = camel_ponte_roma, black_denim, grey_interlock, pink_solid, red_jet_set
_OTHERS = ivory_rib_knit, white_dots_on_black, white_swim_solid, royal_target
FIVE = {make.__name__: make for make in _STUDY}
MEASURED = {make.__name__: make for make in (*_STUDY, *_OTHERS)}
