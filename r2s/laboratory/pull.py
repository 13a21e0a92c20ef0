"""Uniaxial pulls of strips: a curve of tension over stretch, as tensile testers give it.

The model is a strip in uniform strain with free sides: at a given stretch it contracts and shears
so that its energy is least. Clamps hold the width: a strip four times as long as wide pulls within
3 % of the model, a square one of an isotropic sheet within 15 %.

The extension at which the strip is taut and free of force, its zero, is uncertain: pretension puts
it before the first reading, slack after it. `rest_of` reads it from the curve, with a standard
deviation, and an estimate moves it along with the fabric.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r2s._util.checks import expect
from r2s.materials.fabric import Fabric
from r2s.materials.membrane import MembraneLaw, turned

SAMPLES = 24  # of a curve, evenly over its stretch
SPECIMEN = 0.05  # relative, by which specimens of a fabric differ (standard deviation)
READING = 0.02, 0.005  # of a tension: relative, and of the largest of its curve
WIDTH = 0.02  # of a relative width
BACK, BROKEN, PRELOAD = 0.1, 0.7, 0.3  # shares of the largest, beyond which it is no pull
PARTS, RISE = 50, 5.0  # of a curve whose start is sought; first slope: forces up to so many visible
NEWTON = 30  # iterations at most; each is exact for a law of constant stiffness


class Pull(eqx.Module):
    """A uniaxial pull.

    - `stretch`: length over rest length, [-].
    - `tension`: force over the strip's width at rest, [N/m].
    - `across`: width in its middle over that at rest, [-]; NaN where it was not measured.
    - `direction`: of the pull, from the warp, [rad].
    - `specimen`: relative standard deviation between specimens of a fabric, [-].
    - `zero`: the reading of the extension at rest, from which the stretch counts, [m];
      `zero_deviation`: its standard deviation, [m], 0 where it is known.
    - `length`: of the strip at rest, [m].
    - `name`: for messages.
    """

    stretch: Float[Array, " sample"]
    tension: Float[Array, " sample"]
    across: Float[Array, " sample"]
    direction: Float[Array, ""]
    specimen: Float[Array, ""]
    zero: Float[Array, ""]
    zero_deviation: Float[Array, ""]
    length: Float[Array, ""]
    name: str = eqx.field(static=True, default="pull")

    @classmethod
    def make(
        cls,
        extension: Sequence[float] | np.ndarray,
        force: Sequence[float] | np.ndarray,
        size: tuple[float, float],
        direction: float = 0.0,
        width: Sequence[float] | np.ndarray | None = None,
        specimen: float = SPECIMEN,
        name: str = "pull",
        *,
        pretension: float | None = None,
        zero: float | None = None,
    ) -> "Pull":
        """From what a tester writes, thinned to `SAMPLES` means over equal parts of the stretch.

        - `extension`, `force`: [m], [N], of a load that grows.
        - `size`: length between the clamps where the extension counts from, and width at rest, [m].
        - `direction`: of the pull, from the warp, [rad].
        - `width`: of its middle at each sample, [m], where measured.
        - `pretension`: force under which the strip was clamped, [N]; it is added where the tester
          counts the force from there. None: as the force at rest shows it.
        - `zero`: reading of the extension at rest, [m]; None: as the curve shows it, see `rest_of`.

        Raises `ValueError` that names the pull and what is wrong with the curve or its units.
        """
        length, wide = size
        extension, force = np.asarray(extension, float), np.asarray(force, float)
        expect(0 < wide < 5 and 0 < length < 5, f"{name}: sizes are in metres, got {size}")
        is_curve = extension.ndim == 1 and extension.shape == force.shape and len(force) >= 3
        expect(is_curve, f"{name}: expected three samples or more, as many forces as extensions")
        expect(0 < specimen < 1, f"{name}: specimen is a share such as 0.05, got {specimen}")
        middle = np.full(len(force), np.nan) if width is None else np.asarray(width, float) / wide
        expect(middle.shape == force.shape, f"{name}: as many widths as forces are needed")
        is_force = pretension is None or 0 < pretension < np.inf
        expect(is_force, f"{name}: a pretension is a force [N] above 0, got {pretension}")
        _check(name, extension / length, force / wide, middle)
        rest = Rest(zero, 0.0, 0.0) if zero is not None else rest_of(extension, force, pretension)
        first, last = float(extension.min()), float(extension.max())
        where = f"{name}: the zero, {rest.extension:.3g} m, is beyond all extensions"
        expect(rest.extension < last, f"{where}: give the extension at rest [m] as 'zero'")
        share = (first - rest.extension) / (last - rest.extension)
        expect(
            zero is not None or share < (PRELOAD if pretension is None else BROKEN),
            f"{name}: at rest the force is {share:.0%} of the largest: give the 'pretension' [N] "
            "under which the strip was clamped, or its 'zero', the extension at rest [m], or "
            "subtract the machine's offset from the forces",
        )
        # the clamps are `length` apart at a reading of 0, or at the first of a machine's position
        length += rest.extension - min(0.0, first, key=lambda at: abs(at - rest.extension))
        stretch, tension = 1 + (extension - rest.extension) / length, (force - rest.force) / wide
        columns = _thinned(np.stack([stretch, tension, middle], axis=1))
        expect(len(columns) >= 3, f"{name}: fewer than three samples have a force above zero")
        stretches, tensions, widths = (jnp.asarray(column, float) for column in columns.T)
        numbers = direction, specimen, rest.extension, rest.deviation, length
        scalars = (jnp.asarray(number, float) for number in numbers)
        return cls(stretches, tensions, widths, *scalars, name=name)

    @property
    def count(self) -> int:
        """How many data it has: its tensions, and all widths together."""
        return self.tension.size + int(np.isfinite(np.asarray(self.across)).any())

    def expected(
        self, fabric: Fabric, shift: Float[Array, ""] | float = 0.0
    ) -> tuple[Float[Array, " sample"], Float[Array, " sample"]]:
        """Tension [N/m] and relative width [-] of a fabric at the stretches of the pull, whose zero
        is `shift` [m] later than `zero`."""
        at = jax.vmap(lambda stretch: uniaxial(fabric.membrane, stretch, self.direction))
        return at(self.stretch / (1 + shift / self.length))

    def misfit(self, fabric: Fabric, shift: Float[Array, ""] | float = 0.0) -> Float[Array, ""]:
        """Root mean square of the error of the tension, over the largest of the pull, [-]."""
        off = self.expected(fabric, shift)[0] - self.tension
        return jnp.sqrt(jnp.mean(off**2)) / jnp.max(self.tension)

    def residuals(
        self, fabric: Fabric, shift: Float[Array, ""] | float = 0.0
    ) -> Float[Array, " residual"]:
        """How far a fabric is from the curve, in standard deviations that err independently.

        All tensions of a curve err together by `specimen`, and each by its `READING`. `shift`: of
        the zero, [m].
        """
        expected, across = self.expected(fabric, shift)
        alone = jnp.hypot(READING[0] * self.tension, READING[1] * jnp.max(self.tension))
        together = self.specimen * self.tension
        covariance = jnp.diag(alone**2) + together[:, None] * together[None]
        root = jnp.linalg.cholesky(covariance)
        off = jax.scipy.linalg.solve_triangular(root, expected - self.tension, lower=True)
        seen = jnp.isfinite(self.across)
        wide = jnp.where(seen, (across - jnp.where(seen, self.across, 0)) / WIDTH, 0)
        return jnp.concatenate([off, wide / jnp.sqrt(jnp.maximum(jnp.sum(seen), 1))])


def uniaxial(
    membrane: MembraneLaw, stretch: Float[Array, ""], direction: Float[Array, ""] | float
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Tension [N/m, over the rest width] and relative width [-] of a strip with free sides.

    - `stretch`: length over rest length, [-].
    - `direction`: of the pull, from the warp, [rad].

    Raises `TypeError` for a law that follows the strain step by step, since it has no energy.
    """
    if type(membrane.at(jnp.zeros(3, float))) is not type(membrane):
        raise TypeError(f"{type(membrane).__name__} has no energy: take its law at a strain")
    direction = jnp.asarray(direction, float)
    along = (stretch**2 - 1) / 2

    def energy(along, free):  # `free`: strain across, and shear
        strain = jnp.stack([along, *free])
        return membrane.energy_density(turned(strain, -direction))

    slope = jax.grad(energy, argnums=1)

    def step(free):
        tangent = jax.jacfwd(slope, argnums=1)(along, free)
        return free - jnp.linalg.solve(tangent, slope(along, free))

    free = jax.lax.fori_loop(0, NEWTON, lambda _, free: step(free), jnp.zeros(2, float))
    free = step(jax.lax.stop_gradient(free))  # so it has the derivatives of the minimum
    tension = stretch * jax.grad(energy)(along, free)
    return tension, jnp.sqrt(jnp.maximum(1 + 2 * free[0], 1e-6))


class Rest(NamedTuple):
    """Where a pull is taut and free of force.

    - `extension`, `deviation`: its reading and the standard deviation of that, [m].
    - `force`: what the machine shows there, [N].
    """

    extension: float
    deviation: float
    force: float


def rest_of(
    extension: Float[np.ndarray, " sample"],
    force: Float[np.ndarray, " sample"],
    pretension: float | None = None,
) -> Rest:
    """The zero of a pull [m], [N] as its curve shows it.

    A line through the first forces that stand out of the noise meets the force before them. If that
    is well after the first reading, the strip was slack, and what the machine showed is its zero.
    Else it was taut, and the line goes on to no force (or from `pretension` [N], where the machine
    counts from there); a force below none is an offset of the machine.
    """
    ends = np.linspace(extension.min(), extension.max(), PARTS + 1)[1:-1]
    d, f = _means(np.stack([extension, force], axis=1), ends).T
    first, span, part = float(extension.min()), np.ptp(f), np.ptp(d) / PARTS
    noise = np.median(np.abs(np.diff(f, 2))) if len(f) > 2 else 0.0  # 1.7 standard deviations
    visible = min(max(READING[1] * span, 3 * noise), span / 10)
    start = min(int(np.flatnonzero(f - f[0] <= visible)[-1]) + 1, len(f) - 2)
    stop = max(start + 4, int(np.argmax(f - f[0] > RISE * visible)))
    slope, at_none = np.polyfit(d[start:stop], f[start:stop], 1)
    if slope <= 0:
        slope, at_none = span / np.ptp(d), f[0] - span / np.ptp(d) * d[0]
    taut, at_first = (f[0] - at_none) / slope, at_none + slope * first
    shown, reach = min(at_first, 0.0), np.inf
    if taut > first + 1.5 * part:
        shown, reach = np.mean(f[d < taut - part / 2]), np.ptp(d[start:stop])
    elif pretension is not None and at_first < pretension / 2:
        shown = at_first - pretension
    rest = (shown - at_none) / slope
    # as far as it is extrapolated, since curves bend; and the reading error of four means
    doubt = np.hypot(min(abs(rest - first), reach), READING[1] * span / slope / 2)
    return Rest(float(rest), float(doubt), float(shown))


def _check(name: str, strain: np.ndarray, tension: np.ndarray, across: np.ndarray) -> None:
    """Raise `ValueError` for a curve that is no pull or has other units."""
    is_finite = np.isfinite(strain).all() and np.isfinite(tension).all()
    expect(is_finite, f"{name}: extension and force must be finite")
    strain = strain - strain.min()
    most, strongest = float(strain.max()), float(tension.max())
    size = f"{name}: the strip stretches by {most:.2g} of its length at most"
    expect(most > 2e-3, f"{size}: is the extension in metres?")
    expect(most < 4, f"{size}: is the extension in per cent, or in millimetres?")
    stiffest = f"{name}: a stiffness of {strongest / most:.3g} N/m is above that of any fabric"
    expect(strongest < 2e5 * most, f"{stiffest}: is the force in grams or millinewtons?")
    back = float(np.max(np.maximum.accumulate(strain) - strain)) / most
    expect(back < BACK, f"{name}: the extension goes back by {back:.0%}: leave out the unloading")
    rises = tension[np.argmax(strain)] > max(0.0, float(tension[np.argmin(strain)]))
    expect(rises, f"{name}: the force does not rise with the extension: are columns swapped?")
    last = tension[strain > 0.98 * most].mean()
    expect(last > BROKEN * strongest, f"{name}: the force falls before the end: leave that out")
    widths = across[np.isfinite(across)]
    expect(((widths > 0.05) & (widths < 3)).all(), f"{name}: are the widths in metres?")


def _thinned(curve: Float[np.ndarray, "sample 3"]) -> Float[np.ndarray, "mean 3"]:
    """Means over equal parts of the stretch; what is at rest says nothing."""
    curve = curve[(curve[:, 0] > 1) & (curve[:, 1] > 0)]
    if not len(curve):
        return curve
    return _means(curve, np.linspace(1, curve[:, 0].max() * (1 + 1e-9), SAMPLES + 1))


def _means(
    curve: Float[np.ndarray, "sample column"], ends: Float[np.ndarray, " end"]
) -> Float[np.ndarray, "mean column"]:
    """Of the samples between ends of the first column, where there are some."""
    part = np.digitize(curve[:, 0], ends)
    return np.stack([curve[part == i].mean(axis=0) for i in np.unique(part)])
