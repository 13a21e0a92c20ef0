"""How well fabrics predict motions, beside what one knows of a weight alone."""

import jax
import numpy as np
from _tables import Line

from r2s import scenarios
from r2s.evaluation.prediction_error import predict_motion
from r2s.fabrics import prior
from r2s.fabrics.fabric import Fabric
from r2s.scenarios import synthetic
from r2s.scenarios.scenario import Scenario, from_recording

MOTIONS, JUDGED, DRAWS = ("folding", "fling", "shaking"), (17, 17), 8


def predicted(truth: Fabric, name: str, found: Fabric) -> Line:
    """Errors [mm] of an estimate in three motions, beside those of the middle and of draws of the
    prior of its weight."""
    line: Line = {}
    density, key = float(truth.density), jax.random.key(0)
    others = prior.fabrics(density, DRAWS, jax.random.key(3))
    for motion in MOTIONS:
        seen = synthetic.record(scenarios.SIX[motion](), truth, name, shape=JUDGED, key=key)
        scenario = from_recording(seen, JUDGED)
        true = predict_motion(scenario, truth).x
        draws = [_off(scenario, each, true) for each in others]
        line |= {
            motion: f"{_off(scenario, found, true):.1f}",
            f"{motion}, middle": f"{_off(scenario, prior.middle(density), true):.1f}",
            f"{motion}, draws": f"{np.mean(draws):.1f}",
        }
    return line


def _off(scenario: Scenario, fabric: Fabric, true: np.ndarray) -> float:
    """Mean distance of the vertices from the true ones, [mm]."""
    x = predict_motion(scenario, fabric).x
    return 1e3 * float(np.mean(np.linalg.norm(np.asarray(x) - np.asarray(true), axis=-1)))
