"""The main job: estimate each fabric from its lift, judge the estimates on the unseen folds."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import jax
import numpy as np
from tqdm import tqdm

from r2s.estimators import diffcloud
from r2s.estimators.descent import DEFAULT
from r2s.estimators.descent import Effort as Cost
from r2s.estimators.estimate import FORMAT, Estimate, as_json, from_json
from r2s.estimators.problem import Problem
from r2s.family import OrthotropicFamily
from r2s.files import write_json
from r2s.study import judge
from r2s.study.pairs import Pair
from r2s.study.tables import Row, write_rows

SOLVER = "cloth"


@dataclass(frozen=True)
class Effort:
    """What an estimate may `cost`, and its `recipe`: "default" or "original" (DIFFCLOUD's)."""

    cost: Cost = DEFAULT
    recipe: str = "default"
    seed: int = 0


@dataclass(frozen=True)
class Judged:
    """A pair, its estimate, and the motions to draw: of the default fabric and of the estimate."""

    pair: Pair
    estimate: Estimate
    before: dict[str, np.ndarray]
    after: dict[str, np.ndarray]


def run(pairs: Sequence[Pair], out: Path, effort: Effort) -> tuple[list[Judged], list[Row]]:
    """Estimates and rows for all pairs; writes `estimates/NAME.json` and `results.csv` in `out`.

    An estimate that `out` holds already, for the same recording and effort, is read, not made
    again: an interrupted run resumes.
    """
    estimates = [_estimate(pair, out, effort) for pair in tqdm(pairs, "estimates", disable=None)]
    judged, rows = [], []
    for index, pair in enumerate(tqdm(pairs, "evaluations", disable=None)):
        other = _other_fabric(pairs, index)
        others = None if other is None else estimates[other]
        result, new = _judge(pair, estimates[index], others)
        judged.append(result)
        rows += new
        write_rows(out / "results.csv", rows)
    return judged, rows


def _other_fabric(pairs: Sequence[Pair], index: int) -> int | None:
    """The next pair of another fabric, going round."""
    mine = pairs[index].lift.info.fabric
    order = [(index + step) % len(pairs) for step in range(1, len(pairs))]
    return next((i for i in order if pairs[i].lift.info.fabric != mine), None)


def problem_of(pair: Pair) -> Problem:
    """The estimation problem of a pair, at the default size."""
    return Problem.make(pair.lift, OrthotropicFamily.make(pair.density))


def _estimate(pair: Pair, out: Path, effort: Effort) -> Estimate:
    path = out / "estimates" / f"{pair.lift.info.name}.json"
    key = _key(pair, effort)
    if path.exists():
        found = json.loads(path.read_text())
        if found.get("key") == key:
            return from_json(found)
    estimate = _approach(effort)(pair)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {"key": key, "recording": pair.lift.info.name, **as_json(estimate)})
    return estimate


def _approach(effort: Effort) -> Callable[[Pair], Estimate]:
    if effort.recipe == "original":
        return lambda pair: diffcloud.original(
            problem_of(pair), OrthotropicFamily.make(pair.density).middle()
        )
    if effort.recipe != "default":
        raise ValueError(f"recipe is 'default' or 'original', got {effort.recipe!r}")
    return lambda pair: diffcloud.estimate(
        problem_of(pair), effort.cost, key=jax.random.key(effort.seed)
    )


def _key(pair: Pair, effort: Effort) -> str:
    """A hash of what an estimate depends on: the recording's arrays and the effort."""
    digest = sha256(repr((FORMAT, effort, pair.density, pair.lift.info)).encode())
    for leaf in jax.tree.leaves(pair.lift):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()


def _judge(pair: Pair, estimate: Estimate, others: Estimate | None) -> tuple[Judged, list[Row]]:
    default = OrthotropicFamily.make(pair.density).middle()
    fabrics = {"": estimate.fabric, "default": default}
    if others is not None:
        fabrics["other_fabric"] = others.fabric
    before, after, rows = {}, {}, []
    for recording in (pair.lift, pair.fold):
        scenario = recording.info.scenario
        for baseline, fabric in fabrics.items():
            x = judge.predict(recording, fabric)
            {"": after, "default": before}.get(baseline, {})[scenario] = x
            measured = judge.against_motion(recording, x)
            rows += _rows(pair, estimate, scenario, baseline, measured)
    if pair.other_trial is not None:
        measured = judge.against_recording(pair.fold, pair.other_trial)
        rows += _rows(pair, estimate, pair.fold.info.scenario, "repeatability", measured)
    return Judged(pair, estimate, before, after), rows


def _rows(pair: Pair, estimate: Estimate, scenario: str, baseline: str, measured) -> list[Row]:
    info = pair.lift.info
    evaluated = pair.fold.info.name if scenario == pair.fold.info.scenario else info.name
    return [
        Row(
            estimate.approach.split(" ")[0],
            SOLVER,
            info.scenario,
            info.fabric,
            info.trial,
            evaluated,
            scenario,
            baseline,
            metric,
            judge.UNITS.get(metric, "m"),
            value,
        )
        for metric, value in measured.items()
    ]
