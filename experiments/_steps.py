"""What implicit steps and coarser meshes leave in a motion."""

import dataclasses

import numpy as np
from _motions import distance, run
from _tables import Line

from r2s.scenarios.in_explicit_steps import explicit_cloth
from r2s.scenarios.scenario import Scenario
from r2s.study.sources import SyntheticRecording, strain_dependent

FINE, COARSER = 33, (9, 17)  # vertices a side
SHARES = (1, 2, 4)  # steps for one of the scenario's


def apart_in_steps(scenario: str, fabric: str) -> Line:
    """The line of a table: how far [mm] a motion is from that in explicit steps."""
    experiment, law = SyntheticRecording(fabric, scenario, 0).experiment, strain_dependent(fabric)
    first, last = experiment.frames_used
    fine = experiment.scenario((FINE, FINE))

    def moved(scenario: Scenario, count: int = FINE, solver=None) -> np.ndarray:
        x = np.asarray(run(scenario, law, solver=solver).x)[first : last + 1]
        every = (count - 1) // (min(COARSER) - 1)
        return x.reshape(len(x), count, count, 3)[:, ::every, ::every]

    truth = moved(fine, solver=explicit_cloth(fine, law))

    def away(x: np.ndarray) -> str:
        return f"{distance(scenario, x, truth).mean():.1f}"

    found: Line = {}
    for share in SHARES:
        steps = dataclasses.replace(fine, substeps=share * fine.substeps)
        found[f"{1e3 * fine.interval / steps.substeps:.1f} ms"] = away(moved(steps))
    for count in COARSER:
        found[f"{count} x {count}"] = away(moved(experiment.scenario((count, count)), count))
    return found
