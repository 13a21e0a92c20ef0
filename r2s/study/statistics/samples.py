"""What a study is a sample of: fabrics, each with one number, and what they have in common.

Conclusions are meant for fabrics like those of the study. So each comparison is first reduced to
one number for each fabric, and those are the sample. Recordings and estimates of one fabric are not
further members of it, however many they are: they make its number more certain. As all fabrics were
moved alike, what the motions contribute is alike in all of them (`r2s.evaluation.crossed`).
"""

import numpy as np
from jaxtyping import Float

from r2s.study.statistics.result_array import ResultArray, safe_ratio


def finite_mean(values: Float[np.ndarray, "..."], axis: int) -> Float[np.ndarray, "..."]:
    """The mean of what is finite, NaN where nothing is."""
    finite = np.isfinite(values)
    total = np.asarray(np.where(finite, values, 0.0).sum(axis=axis))
    return safe_ratio(total, np.asarray(finite.sum(axis=axis)))


def log_distances(
    results: ResultArray,
) -> Float[np.ndarray, "configuration trajectory repeat"]:
    """The logarithm of each distance; NaN where absent, zero or diverged.

    What has one repeat alone, such as a default fabric, has it beside every repeat of others.
    """
    logs = np.log(np.where(results.values > 0, results.values, np.nan))
    alone = results.present.sum(axis=2, keepdims=True) == 1
    return np.where(alone, finite_mean(logs, 2)[..., None], logs)


def of_fabrics(
    results: ResultArray, values: Float[np.ndarray, "*more trajectory"]
) -> Float[np.ndarray, "*more fabric"]:
    """The mean of a fabric's trajectories that are finite."""
    names = np.array([trajectory.fabric for trajectory in results.trajectories])
    means = [finite_mean(values[..., names == name], -1) for name in results.fabrics]
    return np.stack(means, axis=-1) if means else np.zeros((*values.shape[:-1], 0))


def by_movement(
    results: ResultArray, values: Float[np.ndarray, " trajectory"]
) -> Float[np.ndarray, "fabric movement"]:
    """Values of trajectories by fabric and what fabrics have in common; NaN where one lacks it."""
    movements = {t.movement: None for t in results.trajectories}
    column = {movement: i for i, movement in enumerate(movements)}
    line = {fabric: i for i, fabric in enumerate(results.fabrics)}
    table = np.full((len(line), len(column)), np.nan)
    for trajectory, value in zip(results.trajectories, values, strict=True):
        table[line[trajectory.fabric], column[trajectory.movement]] = value
    return table
