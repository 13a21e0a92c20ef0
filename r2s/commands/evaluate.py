"""`r2s evaluate`: how well a card predicts recordings."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


@dataclass(frozen=True)
class Evaluate:
    """Say how well a fabric predicts recorded motions: distances in metres, mean over the frames.

    chamfer_real_to_sim is the mean distance from a recorded point to the simulated surface,
    chamfer_sim_to_real the reverse, hausdorff the largest; `paper_` figures have no unit.

        r2s evaluate denim.json fold.npz
        r2s evaluate grey_interlock recordings/fold_tan --json
    """

    fabric: Annotated[Positional[str], arg(metavar="PRESET|CARD")]
    """A preset of `r2s.fabrics.presets`, or the file of a fabric card."""
    recordings: Annotated[Positional[tuple[Path, ...]], arg(metavar="RECORDING")]
    """NPZ, or folders."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        import math

        from r2s.commands.common import card_of, recordings_of, tell
        from r2s.evaluation import prediction_error

        card, found = card_of(self.fabric), {}
        for recording in recordings_of(self.recordings):
            x = prediction_error.predict(recording, card.fabric)
            found[recording.info.name] = prediction_error.against_motion(recording, x)
        if not found:
            raise ValueError("no recording: name an NPZ, or a folder that holds some")
        lines, diverged = [], []
        for name, metrics in found.items():
            lines.append(f"{name}:")
            for metric, value in metrics.items():
                unit = prediction_error.UNITS.get(metric, "m")
                text = f"{value:.4f}" if unit == "-" else f"{1e3 * value:.2f} mm"
                lines.append(f"    {metric:32s}{text:>12s}")
            if math.isnan(metrics["chamfer_real_to_sim"]):
                diverged.append(name)
                lines.append("    the simulation diverged")
        units = {name: prediction_error.UNITS.get(name, "m") for name in next(iter(found.values()))}
        tell(self.json, {"fabric": card.name, "units": units, "recordings": found}, lines)
        return 1 if diverged else 0
