"""`r2s evaluate`: how close a fabric's simulation comes to recorded motions."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from tyro.conf import Positional, arg

from r2s.cli.common import ChosenShape, FabricName, Json

if TYPE_CHECKING:
    from r2s.estimation.cards import Card
    from r2s.recordings.recording import Recording

DISTANCE = "surface"
CROPPED = "; without the simulated sheet below the lowest recorded point"


@dataclass(frozen=True)
class Evaluate:
    """Measure how well a fabric predicts recorded motions.

    Prints the mean distance of all recorded points from the simulated surface, over the frames that
    count; beside it the same distance for the prior mean (the fabric that one would guess from the
    weight alone), and what the noise of the points and the simulated mesh allow.

        r2s evaluate denim.json fold.npz
        r2s evaluate denim.json fling.npz --plot fling.png
        r2s evaluate grey_interlock recordings/fold_tan --json
    """

    fabric: Positional[FabricName]
    recordings: Annotated[Positional[tuple[Path, ...]], arg(metavar="RECORDING")]
    """NPZ, or folders."""
    shape: ChosenShape = None
    all: bool = False
    """Print the other distances, too, with what each is."""
    plot: Annotated[Path | None, arg(metavar="FILE")] = None
    """A PNG of the last recording: its points in three frames, with the sheet of the fabric and
    that of the prior mean, and the distance under each."""
    json: Json = False

    def run(self) -> int:
        from r2s._util.threads import one_at_a_time
        from r2s.cli.common import check_picture, load_card, print_result
        from r2s.metrics.prediction_error import UNITS
        from r2s.recordings.open import open_recordings

        check_picture(self.plot)
        one_at_a_time()
        card, lines = load_card(self.fabric), []
        judged: dict[str, Judged] = {}
        recordings = list(open_recordings(self.recordings))
        for recording in recordings:
            evaluation = self._judge(card, recording, recording is recordings[-1])
            judged[recording.info.name] = evaluation
            lines += evaluation.lines(recording.info.name, self.all)
        if not judged:
            raise ValueError("no recording: name an NPZ, or a folder that holds some")
        failures = {name: each.failure for name, each in judged.items() if each.failure}
        metrics = {name: each.metrics for name, each in judged.items()}
        units = {name: UNITS.get(name, "m") for name in next(iter(metrics.values()))}
        result = {"fabric": card.name, "units": units, "recordings": metrics, "failures": failures}
        result["prior_mean"] = {name: each.prior_mean for name, each in judged.items()}
        result["noise"] = {name: each.noise for name, each in judged.items()}
        result["meshes"] = {name: each.mesh for name, each in judged.items()}
        result["estimated_from"] = [name for name, each in judged.items() if each.is_own]
        print_result(self.json, result, lines)
        return 1 if failures else 0

    def _judge(self, card: "Card", recording: "Recording", is_last: bool) -> "Judged":
        import numpy as np

        from r2s.cli.common import choose_shape
        from r2s.estimation.cards import fingerprint
        from r2s.estimation.held_out import in_steps
        from r2s.materials import prior
        from r2s.metrics import prediction_error
        from r2s.recordings.checks import mean_distance, point_noise

        info, fabric = recording.info, card.fabric
        shape, mesh, words = choose_shape(self.shape, fabric, info.sheet.size, info.scenario)
        scenario = in_steps(recording, shape)
        motion = prediction_error.predict_motion(scenario, fabric)
        guess = prediction_error.predict_motion(scenario, prior.middle(float(fabric.density)))
        surface, guessed = (
            float(np.mean(prediction_error.from_surface(recording, x, shape)))
            for x in (motion.x, guess.x)
        )
        metrics = {DISTANCE: surface}
        metrics |= prediction_error.against_motion(recording, motion.x, shape=shape)
        if self.plot is not None and is_last:
            self._draw(self.plot, recording, scenario.scene.mesh.faces, motion.x, guess.x)
        failed = math.isnan(metrics[DISTANCE])
        own = fingerprint(recording) in {digest for _, digest in card.provenance.recordings}
        noise = mean_distance(point_noise(recording))
        why = str(motion.failure) if failed else ""
        return Judged(metrics, guessed, noise, mesh, words, why, own)

    def _draw(self, path: Path, recording: "Recording", faces, x, guess) -> None:
        from r2s.recordings.open import SimulatedCloth
        from r2s.viewer.comparison import draw_prediction

        motions = {self.fabric: x, "prior mean": guess}
        sheets = {Path(name).stem: SimulatedCloth(each, faces) for name, each in motions.items()}
        draw_prediction(path, recording, sheets)


class Judged(NamedTuple):
    """What `Evaluate` says of one recording.

    - `metrics`: those of `r2s.metrics.prediction_error`. `prior_mean`, `noise`: mean distances [m]
      that the prior mean leaves, and that the noise of the points alone gives.
    - `mesh`, `words`: of the simulated mesh. `failure`: why the simulation diverged, or "".
    - `is_own`: whether the card was estimated from this recording.
    """

    metrics: dict[str, float]
    prior_mean: float
    noise: float
    mesh: dict[str, Any]
    words: list[str]
    failure: str
    is_own: bool

    def lines(self, name: str, with_all: bool) -> list[str]:
        """For people."""
        from r2s._util.units import millimetres
        from r2s.metrics.prediction_error import METRICS

        if self.failure:
            return [f"{name}: the simulation {self.failure}"]
        distances = self.metrics[DISTANCE], self.prior_mean, self.noise
        own, guess, noise = map(millimetres, distances)
        lines = [
            f"{name}: mean distance of all points {own}; prior mean {guess}; the noise of its "
            f"points allows {noise}",
            *(f"    {words}" for words in self.words),
        ]
        if self.is_own:
            lines.append(
                "    the card was estimated from this recording, which tests no prediction"
            )
        if with_all:
            for metric, value in self.metrics.items():
                text = f"{value:.4f}" if metric.startswith("paper_") else millimetres(value)
                _, words = METRICS[metric.removesuffix("_cropped")]
                words += CROPPED * metric.endswith("_cropped")
                lines.append(f"    {metric:29s}{text:>10s}  {words}")
        return lines
