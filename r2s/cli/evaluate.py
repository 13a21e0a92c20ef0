"""`r2s evaluate`: how well a card predicts recordings."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from r2s.cli.common import ChosenShape, FabricName, Json


@dataclass(frozen=True)
class Evaluate:
    """Say how well a fabric predicts recorded motions: distances in metres, mean over the frames.

    chamfer_real_to_sim is the mean distance from a recorded point to the simulated surface,
    chamfer_sim_to_real the reverse, hausdorff the largest; `paper_` figures have no unit.

        r2s evaluate denim.json fold.npz
        r2s evaluate grey_interlock recordings/fold_tan --json
    """

    fabric: Positional[FabricName]
    recordings: Annotated[Positional[tuple[Path, ...]], arg(metavar="RECORDING")]
    """NPZ, or folders."""
    shape: ChosenShape = None
    json: Json = False

    def run(self) -> int:
        from r2s.cli.common import choose_shape, load_card, print_result
        from r2s.metrics import prediction_error
        from r2s.recordings.open import open_recordings
        from r2s.scenarios.scenario import from_recording

        card, found, failures, lines = load_card(self.fabric), {}, {}, []
        meshes: dict[str, dict] = {}
        for recording in open_recordings(self.recordings):
            name, size = recording.info.name, recording.info.sheet.size
            shape, meshes[name], words = choose_shape(
                self.shape, card.fabric, size, recording.info.scenario
            )
            motion = prediction_error.predict_motion(from_recording(recording, shape), card.fabric)
            metrics = prediction_error.against_motion(recording, motion.x, shape=shape)
            found[name] = metrics
            lines += [f"{name}:", *(f"    {line}" for line in words)]
            lines += [_line(metric, value) for metric, value in metrics.items()]
            if math.isnan(metrics["chamfer_real_to_sim"]):
                failures[name] = motion.failure
                lines.append(f"    the simulation {failures[name]}")
        if not found:
            raise ValueError("no recording: name an NPZ, or a folder that holds some")
        units = {name: prediction_error.UNITS.get(name, "m") for name in next(iter(found.values()))}
        result = {"fabric": card.name, "units": units, "recordings": found, "failures": failures}
        result["meshes"] = meshes
        print_result(self.json, result, lines)
        return 1 if failures else 0


def _line(metric: str, value: float) -> str:
    from r2s.metrics.prediction_error import UNITS

    text = f"{value:.4f}" if UNITS.get(metric) == "-" else f"{1e3 * value:.2f} mm"
    return f"    {metric:32s}{text:>12s}"
