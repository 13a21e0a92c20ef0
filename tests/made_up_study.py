"""Made-up results and motions of a study, whose effects are known."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd

from r2s.mesh.mesh import rectangle
from r2s.study.configuration import MOTIONS, PAPER_CONFIGURATIONS, Configuration
from r2s.study.figures import Motion
from r2s.study.results import as_frame, labelled

FABRICS = ("black_denim", "grey_interlock", "pink_solid")
METRICS = {"chamfer": ("m", 1.0), "paper_chamfer": ("-", 20.0), "hausdorff": ("m", 3.0)}


def flat_distance(
    configuration: Configuration, fabric: str, motion: str, trial: int, repeat: int
) -> float:
    """The same everywhere, [m]."""
    return 0.02


def made_up_results(
    distance: Callable[[Configuration, str, str, int, int], float] = flat_distance,
    configurations: Sequence[Configuration] = PAPER_CONFIGURATIONS,
    fabrics: Sequence[str] = FABRICS,
    motions: Sequence[str] = MOTIONS,
    trials: int = 4,
    repeats: int = 2,
    noise: float = 0.1,
    seed: int = 0,
    metrics: Sequence[str] = tuple(METRICS),
) -> pd.DataFrame:
    """Labelled results of `distance` [m], times log-normal noise; 40 mm of the default fabric."""
    generator = np.random.default_rng(seed)
    rows = []
    for configuration in (*configurations, Configuration("", "cloth", "")):
        for fabric in fabrics:
            for motion in motions:
                for trial in range(1, trials + 1):
                    for repeat in range(1, repeats + 1 if configuration.approach else 2):
                        is_default = not configuration.approach
                        value = 0.04
                        if not is_default:
                            value = distance(configuration, fabric, motion, trial, repeat)
                        value *= math.exp(noise * generator.normal())
                        place = configuration._asdict() | {
                            "fabric": fabric,
                            "repeat": str(repeat),
                            "recording": f"{motion}_{fabric}{trial}",
                            "evaluated_on": motion,
                            "baseline": "default" if is_default else "",
                        }
                        for metric in metrics:
                            unit, scale = METRICS[metric]
                            rows.append(
                                place | {"metric": metric, "unit": unit, "value": scale * value}
                            )
    return labelled(as_frame(rows))


def made_up_motion(
    motion: str = "fling", fabric: str = "black_denim", labels: Sequence[str] = ("a", "b")
) -> Motion:
    """A sheet that swings for 1 s in six frames, seen as its own vertices; the configurations lag
    behind it, each more than the one before. The floor is 1 mm, the horizon at 0.7 s."""
    mesh = rectangle((0.4, 0.4), (4, 4))
    rest, times = np.asarray(mesh.rest, float), np.linspace(0.0, 1.0, 6)

    def swung(lag: float) -> np.ndarray:
        angle = 1.5 * np.sin(np.pi * (times - lag))[:, None]
        across = rest[:, 0] * np.cos(angle), rest[:, 0] * np.sin(angle)
        return np.stack([across[0], np.broadcast_to(rest[:, 1], across[0].shape), across[1]], -1)

    motions = {label: swung(0.1 * i) for i, label in enumerate(labels)}
    clouds = tuple(swung(0.0)[i, : len(rest) - i] for i in range(len(times)))
    away = [np.linalg.norm(x - swung(0.0), axis=2).mean(axis=1) for x in motions.values()]
    return Motion(
        fabric,
        motion,
        f"{motion}_{fabric}1",
        times,
        clouds,
        {label: x.reshape(len(times), 4, 4, 3) for label, x in motions.items()},
        {label: distances[None] for label, distances in zip(labels, away, strict=True)},
        floor=np.full(len(times), 1e-3),
        horizon=0.7,
    )
