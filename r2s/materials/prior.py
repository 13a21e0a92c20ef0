"""The distribution of fabrics before any recording, given their areal density.

Not fitted to the fabrics of the study:

- Bending, from the areal density d [kg/m^2]: B = exp(-9.197) d^1.230 [N m], with a standard
  deviation of 0.80 in its logarithm. Fitted to the mean of warp, weft and bias of the 251 distinct
  fabrics in the data of ClothDrapeTester (617 rows, `dataset.csv`, revision 24a980c0).
- Warp, weft and shear: log-normal, as the four fabrics of Wang et al. 2011 that the study does not
  have (`presets.MEASURED` without `presets.FIVE`).
- Coupling, damping, friction: uniform, damping in its logarithm. No measurement is behind these.
"""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import PRNGKeyArray

from r2s._util.units import positive
from r2s.materials import presets
from r2s.materials.fabric import Fabric
from r2s.materials.membrane import OrthotropicMembrane
from r2s.materials.parameters import InformedSpace, ParameterSpace
from r2s.materials.plate import PlateBending

BENDING, EXPONENT, SPREAD = -9.197, 1.230, 0.80  # of the logarithms
COUPLING, DAMPING, FRICTION = (-0.5, 0.5), (1e-3, 3e-2), (0.2, 0.8)  # -, [s], -
THICKNESS = 1e-3  # [m]
MANY, LEAST = 1024, 1e-3  # draws for a distribution; a deviation below which they do not vary


def draws(density: float, count: int, key: PRNGKeyArray) -> Fabric:
    """`count` fabrics of an areal density [kg/m^2], with a leading axis on every array.

    Of one key they are the same in float32 and float64.
    """
    positive("kg/m^2", density=density)
    keys = jr.split(key, 6)
    mean, deviation = _membranes()
    yarns = jnp.exp(mean[0] + deviation[0] * _normal(keys[0], (2, count)))
    c33 = jnp.exp(mean[1] + deviation[1] * _normal(keys[1], (count,)))
    coupling = _uniform(keys[2], count, COUPLING)
    c11, c22 = yarns / (1 - coupling**2)[None]
    middle = BENDING + EXPONENT * np.log(density)
    bending = jnp.exp(middle + SPREAD * _normal(keys[3], (count,)))
    low, high = np.log(DAMPING)
    return Fabric(
        jnp.full(count, density, float),
        OrthotropicMembrane(c11, coupling * jnp.sqrt(c11 * c22), c22, c33),
        PlateBending(bending, jnp.zeros(count, float)),
        jnp.exp(_uniform(keys[4], count, (low, high))),
        _uniform(keys[5], count, FRICTION),
        jnp.full(count, THICKNESS, float),
        jnp.zeros(count, float),
    )


def fabrics(density: float, count: int, key: PRNGKeyArray) -> list[Fabric]:
    """The `draws`, one by one."""
    drawn = draws(density, count, key)
    return [jax.tree.map(lambda leaf, i=i: leaf[i], drawn) for i in range(count)]


def informed(space: ParameterSpace, density: float) -> InformedSpace:
    """A space with this prior: mean and covariance of the places of `MANY` draws in it.

    Parameters in which draws do not vary, those of a law that stiffens, keep the space's own prior.
    """
    drawn = draws(density, MANY, jr.key(0))
    places = np.asarray(jax.vmap(space.to_unit)(drawn), np.float64)
    varies = places.std(axis=0) > LEAST
    mean, precision = (np.array(part, np.float64) for part in space.prior())
    mean[varies] = np.clip(places[:, varies].mean(axis=0), 0, 1)
    precision[np.ix_(varies, varies)] = np.linalg.inv(np.cov(places[:, varies].T))
    return InformedSpace.make(space, jnp.asarray(mean, float), jnp.asarray(precision, float))


def middle(density: float) -> Fabric:
    """The fabric with the median of every number of the prior, for an areal density [kg/m^2]."""
    positive("kg/m^2", density=density)
    yarn, shear = np.exp(_membranes()[0]).tolist()
    coupling = sum(COUPLING) / 2
    c11 = yarn / (1 - coupling**2)
    return Fabric.make(
        density,
        (c11, coupling * c11, c11, shear),
        float(np.exp(BENDING + EXPONENT * np.log(density))),
        damping=float(np.sqrt(DAMPING[0] * DAMPING[1])),
        friction=sum(FRICTION) / 2,
        thickness=THICKNESS,
    )


def _uniform(key: PRNGKeyArray, count: int, ends: tuple[float, float]) -> jax.Array:
    low, high = ends
    places = jr.uniform(key, (count,), jnp.float32).astype(float)
    return jnp.maximum(low, places * (high - low) + low)


def _normal(key: PRNGKeyArray, shape: tuple[int, ...]) -> jax.Array:
    return jr.normal(key, shape, jnp.float32).astype(float)


def _membranes() -> tuple[np.ndarray, np.ndarray]:
    """Mean and deviation of the logarithms of yarns (warp and weft alike) and shear [N/m]."""
    others = [make() for name, make in presets.MEASURED.items() if name not in presets.FIVE]
    yarns = np.log([[float(f.membrane.c11), float(f.membrane.c22)] for f in others])
    shear = np.log([float(f.membrane.c33) for f in others])
    mean = np.array([yarns.mean(), shear.mean()])
    return mean, np.array([yarns.std(ddof=1), shear.std(ddof=1)])
