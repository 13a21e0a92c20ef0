"""The recordings of a study: lifts to estimate from, folds to be judged on."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax.random as jr

from r2s import manifest, presets, synthetic
from r2s.fabric import Fabric
from r2s.family import OrthotropicFamily
from r2s.recording import Recording

ESTIMATED_FROM, EVALUATED_ON = "lift", "fold"


@dataclass(frozen=True)
class Pair:
    """A trial of a fabric: the recording to estimate from and the one to be judged on.

    `truth` is the fabric where it is known, `density` its areal density [kg/m^2]; `other_trial`
    is a second recording of the motion that judges, None if there is none.
    """

    lift: Recording
    fold: Recording
    density: float
    other_trial: Recording | None
    truth: Fabric | None = None


def synthetic_pairs(fabrics: Sequence[str], seed: int) -> list[Pair]:
    """A lift and two folds of each of these presets, made by the solver."""
    pairs = []
    for index, name in enumerate(fabrics):
        if name not in presets.FIVE:
            raise ValueError(f"no preset {name!r}; there are {', '.join(presets.FIVE)}")
        fabric = presets.FIVE[name]()
        keys = jr.split(jr.fold_in(jr.key(seed), index), 3)
        pairs.append(
            Pair(
                synthetic.lift(fabric, name, 1, key=keys[0]),
                synthetic.fold(fabric, name, 1, key=keys[1]),
                float(fabric.density),
                synthetic.fold(fabric, name, 2, key=keys[2]),
                fabric,
            )
        )
    return pairs


def recorded_pairs(folder: Path, density: float, only: str = "") -> list[Pair]:
    """The pairs of lift and fold in a folder, by its own or the DIFFCLOUD manifest.

    `density` is the areal density to assume [kg/m^2]; `only` a regular expression for the names of
    the lifts. Raises what the readers raise, and `ValueError` when there is no pair.
    """
    OrthotropicFamily.make(density)  # refuses a density that is none, before any reading
    rules = manifest.manifest_for(folder)
    names = manifest.read_recordings(folder, rules, (ESTIMATED_FROM, EVALUATED_ON))
    recordings = {name: manifest.read_recording(folder, rules, name) for name in names}
    folds = {
        (r.info.fabric, r.info.trial): r
        for r in recordings.values()
        if r.info.scenario == EVALUATED_ON
    }
    lifts = [r for r in recordings.values() if r.info.scenario == ESTIMATED_FROM]
    pairs = []
    for lift in lifts:
        fabric, trial = lift.info.fabric, lift.info.trial
        if (fabric, trial) in folds and re.search(only, lift.info.name):
            others = [folds[key] for key in sorted(folds) if key[0] == fabric and key[1] != trial]
            fold = folds[fabric, trial]
            pairs.append(Pair(lift, fold, density, others[0] if others else None))
    if not pairs:
        raise ValueError(
            f"{folder}: no {ESTIMATED_FROM} with a {EVALUATED_ON} of the same fabric and trial"
            f"{f' whose name matches {only!r}' if only else ''}; found {sorted(recordings)}"
        )
    return pairs
