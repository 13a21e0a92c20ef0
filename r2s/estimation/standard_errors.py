"""How far an estimate may be off: what its end says, and what the places around it say of that."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.estimation.gauss_newton import MARGIN, Descent, Joint, Normal, pull
from r2s.estimation.prediction import Theta

FARTHEST = 2.0  # times the median

Near = list[tuple[Theta, Normal]]  # unknowns around the end, and what is there


def covariance(
    problems: Joint, end: Descent, prior, near: Near, true: bool = False
) -> Float[Array, "unknown unknown"]:
    """Of the unknown, at the end of one descent: the sandwich, with the prior.

    To it comes how far from there the next Gauss-Newton step would lead, so that a descent which
    has not arrived does not claim to know: the mean square of that of the end, and of those from
    places `near` it. Where the loss is smooth these lead back to it; where it is rough they lead
    each elsewhere, as descents do. What leads farther than `FARTHEST` times the median, in
    deviations, is taken for as far. If the end is the `true` unknown, where it leads is noise, and
    the others count from there. Where derivatives are not finite nothing is known but the prior.
    """
    off = _led(problems, end, prior, near) - end.unknown[None]
    off = jnp.where(true, off - off[:1], off)
    spread, root = _sandwich(problems, end, prior)
    far = jnp.linalg.norm(jnp.linalg.solve(root, off.T), axis=0)
    limit = FARTHEST * jnp.median(far)
    off = off * jnp.where(far > limit, limit / far, 1)[:, None]
    found = spread + off.T @ off / len(off)
    _, precision = pull(problems, end.unknown)
    return jnp.where(jnp.all(jnp.isfinite(found)), found, jnp.diag(1 / precision))


def apart(problems: Joint, end: Descent, prior, near: Near) -> Float[Array, ""]:
    """How far from where the end leads the places near it do: the median, in deviations.

    About nothing where the loss is smooth; infinite where derivatives are not finite.
    """
    led = _led(problems, end, prior, near)
    _, root = _sandwich(problems, end, prior)
    far = jnp.linalg.norm(jnp.linalg.solve(root, (led - led[:1]).T), axis=0)[1:]
    return jnp.median(jnp.where(jnp.isfinite(far), far, jnp.inf))


def around(
    problems: Joint, end: Descent, prior, count: int, key: PRNGKeyArray
) -> Float[Array, "place unknown"]:
    """Places one deviation away from the end of a descent, an even `count`, in opposite pairs."""
    spread, root = _sandwich(problems, end, prior)
    signs = jax.random.rademacher(key, (count // 2, len(spread)), spread.dtype)
    places = end.unknown[None] + jnp.concatenate([signs, -signs]) @ root.T
    bounded = jnp.arange(len(spread)) < problems[0].space.dim
    return jnp.where(bounded[None], jnp.clip(places, MARGIN, 1 - MARGIN), places)


def _sandwich(problems: Joint, end: Descent, prior):
    """The covariance of an estimate, had it arrived and were the loss smooth, and its root."""
    _, precision = pull(problems, end.unknown)
    inverse = jnp.linalg.inv(end.normal.matrix + prior * jnp.diag(precision))
    spread = inverse @ (end.normal.scatter + prior**2 * jnp.diag(precision)) @ inverse
    deviation = jnp.sqrt(jnp.diag(spread))
    squares, axes = jnp.linalg.eigh(spread / jnp.outer(deviation, deviation))
    least = len(squares) * jnp.finfo(squares.dtype).eps
    return spread, deviation[:, None] * axes * jnp.sqrt(jnp.maximum(squares, least))[None]


def _led(problems: Joint, end: Descent, prior, near: Near) -> Float[Array, "place unknown"]:
    """Where the Gauss-Newton steps of the end and of places near it lead, regardless of bounds.

    Nowhere from a run that diverged, or whose derivatives did.
    """

    def led(unknown: Theta, normal: Normal) -> Theta:
        off, precision = pull(problems, unknown)
        matrix = normal.matrix + prior * jnp.diag(precision)
        step = jnp.linalg.solve(matrix, normal.gradient + prior * precision * off)
        finite = jnp.isfinite(normal.loss) & jnp.all(jnp.isfinite(step))
        return unknown - jnp.where(finite, step, 0)

    return jnp.stack([led(*place) for place in [(end.unknown, end.normal), *near]])
