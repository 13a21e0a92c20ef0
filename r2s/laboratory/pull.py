"""Uniaxial pulls of strips: a curve of tension over stretch, as tensile testers give it.

The model is a strip in uniform strain with free sides: at a given stretch it contracts and shears
so that its energy is least. Clamps hold the width: a strip four times as long as wide pulls within
3 % of the model, a square one of an isotropic sheet within 15 %.
"""

from collections.abc import Sequence

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
BACK, BROKEN, PRELOAD = 0.1, 0.7, 0.15  # shares of the largest, beyond which it is no pull
NEWTON = 30  # iterations at most; each is exact for a law of constant stiffness


class Pull(eqx.Module):
    """A uniaxial pull.

    - `stretch`: length over rest length, [-].
    - `tension`: force over the strip's width at rest, [N/m].
    - `across`: width in its middle over that at rest, [-]; NaN where it was not measured.
    - `direction`: of the pull, from the warp, [rad].
    - `specimen`: relative standard deviation between specimens of a fabric, [-].
    - `name`: for messages.
    """

    stretch: Float[Array, " sample"]
    tension: Float[Array, " sample"]
    across: Float[Array, " sample"]
    direction: Float[Array, ""]
    specimen: Float[Array, ""]
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
    ) -> "Pull":
        """From what a tester writes, thinned to `SAMPLES` means over equal parts of the stretch.

        - `extension`, `force`: [m], [N], of a load that grows.
        - `size`: free length between the clamps and width at rest, [m].
        - `direction`: of the pull, from the warp, [rad].
        - `width`: of its middle at each sample, [m], where measured.

        Raises `ValueError` that names the pull and what is wrong with the curve or its units.
        """
        length, wide = size
        extension, force = np.asarray(extension, float), np.asarray(force, float)
        expect(0 < wide < 5 and 0 < length < 5, f"{name}: sizes are in metres, got {size}")
        is_curve = extension.ndim == 1 and extension.shape == force.shape and len(force) >= 3
        expect(is_curve, f"{name}: expected three samples or more, as many forces as extensions")
        expect(0 < specimen < 1, f"{name}: specimen is a share such as 0.05, got {specimen}")
        stretch, tension = 1 + extension / length, force / wide
        middle = np.full(len(force), np.nan) if width is None else np.asarray(width, float) / wide
        _check(name, stretch, tension, middle)
        columns = _thinned(np.stack([stretch, tension, middle], axis=1))
        expect(len(columns) >= 3, f"{name}: fewer than three samples have a force above zero")
        stretches, tensions, widths = (jnp.asarray(column, float) for column in columns.T)
        angle, spread = (jnp.asarray(number, float) for number in (direction, specimen))
        return cls(stretches, tensions, widths, angle, spread, name)

    @property
    def count(self) -> int:
        """How many data it has: its tensions, and all widths together."""
        return self.tension.size + int(np.isfinite(np.asarray(self.across)).any())

    def expected(self, fabric: Fabric) -> tuple[Float[Array, " sample"], Float[Array, " sample"]]:
        """Tension [N/m] and relative width [-] of a fabric at the stretches of the pull."""
        at = jax.vmap(lambda stretch: uniaxial(fabric.membrane, stretch, self.direction))
        return at(self.stretch)

    def misfit(self, fabric: Fabric) -> Float[Array, ""]:
        """Root mean square of the error of the tension, over the largest of the pull, [-]."""
        off = self.expected(fabric)[0] - self.tension
        return jnp.sqrt(jnp.mean(off**2)) / jnp.max(self.tension)

    def residuals(self, fabric: Fabric) -> Float[Array, " residual"]:
        """How far a fabric is from the curve, in standard deviations that err independently.

        All tensions of a curve err together by `specimen`, and each by its `READING`.
        """
        expected, across = self.expected(fabric)
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


def _check(name: str, stretch: np.ndarray, tension: np.ndarray, across: np.ndarray) -> None:
    """Raise `ValueError` for a curve that is no pull or has other units."""
    is_finite = np.isfinite(stretch).all() and np.isfinite(tension).all()
    expect(is_finite, f"{name}: extension and force must be finite")
    most, strongest = float(stretch.max()) - 1, float(tension.max())
    size = f"{name}: the strip stretches by {most:.2g} of its length at most"
    expect(most > 2e-3, f"{size}: is the extension in metres?")
    expect(most < 4, f"{size}: is the extension in per cent, or in millimetres?")
    stiffest = f"{name}: a stiffness of {strongest / most:.3g} N/m is above that of any fabric"
    expect(strongest < 2e5 * most, f"{stiffest}: is the force in grams or millinewtons?")
    back = float(np.max(np.maximum.accumulate(stretch) - stretch)) / most
    expect(back < BACK, f"{name}: the extension goes back by {back:.0%}: leave out the unloading")
    rises = tension[np.argmax(stretch)] > max(0.0, float(tension[np.argmin(stretch)]))
    expect(rises, f"{name}: the force does not rise with the extension: are columns swapped?")
    last = tension[stretch > 1 + 0.98 * most].mean()
    expect(last > BROKEN * strongest, f"{name}: the force falls before the end: leave that out")
    first = np.min(tension[stretch < 1 + 0.02 * most], initial=strongest) / strongest
    is_loaded = PRELOAD < first < 1
    expect(not is_loaded, f"{name}: at rest the force is {first:.0%} of the largest: subtract it")
    widths = across[np.isfinite(across)]
    expect(((widths > 0.05) & (widths < 3)).all(), f"{name}: are the widths in metres?")


def _thinned(curve: Float[np.ndarray, "sample 3"]) -> Float[np.ndarray, "mean 3"]:
    """Means over equal parts of the stretch; what is at rest says nothing."""
    curve = curve[(curve[:, 0] > 1) & (curve[:, 1] > 0)]
    ends = np.linspace(1, curve[:, 0].max() * (1 + 1e-9), SAMPLES + 1)
    part = np.digitize(curve[:, 0], ends)
    return np.stack([curve[part == i].mean(axis=0) for i in np.unique(part)])
