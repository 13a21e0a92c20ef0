"""Does the physics-informed network find a fabric from clouds of one or several motions together?

python experiments/pinn_from_clouds.py --out docs/results/pinn_from_clouds.csv     # an hour

Clouds are of our own sheet of 17 x 17 vertices. The fit begins with the middle of the range, which
is knowing nothing, or with the true fabric; or the true fabric is held, and the maps alone are
fitted. Printed: the fabric over the truth (coupling: the difference), the spread of the distances
of points from the maps, and the sum of the squares of all residuals.
"""

import dataclasses
import time

import jax
import numpy as np
from _tables import Line, command_line, resumed

from r2s.estimation.pinn.from_clouds import Round, Settings, estimate
from r2s.fabrics import presets
from r2s.fabrics.parameters import OrthotropicSpace
from r2s.scenarios import lifting, synthetic, wind

MOTIONS = {"lifting": lifting, "wind": wind}
SHAPE = (17, 17)  # vertices of the sheet that is recorded
CAPTION = (
    "What clouds lead the network to, over the true fabric (coupling: difference). Begun with the "
    "middle of the range, with the true fabric, or with maps fitted to the true fabric alone."
)
TOLD = ("warp", "weft", "shear", "coupling", "bending")  # no friction acts, damping is left out


def found(fabric: str, motions: str, begin: str) -> Line:
    """The line of a table: one estimate."""
    truth = presets.FIVE[fabric]()
    space = OrthotropicSpace.make(float(truth.density))
    names = motions.split("+")
    keys = jax.random.split(jax.random.key(11), len(names))
    recordings = [
        synthetic.record(MOTIONS[name](), truth, fabric, shape=SHAPE, key=key)
        for name, key in zip(names, keys, strict=True)
    ]
    settings, rounds = Settings(), list[Round]()
    if begin == "truth, held":
        settings = dataclasses.replace(settings, held=settings.rounds)
    place = None if begin == "middle" else np.asarray(space.to_unit(truth))
    began = time.process_time()
    made = estimate(
        recordings, space, settings, begin=place, report=rounds.append, key=jax.random.key(0)
    )
    seconds = time.process_time() - began
    true = np.asarray(space.values(space.to_unit(truth)))
    line: Line = {}
    for bound, value, aim in zip(space.ranges, made.values, true, strict=True):
        if bound.name in TOLD:
            line[bound.name] = f"{value / aim:.2f}" if bound.log else f"{value - aim:+.2f}"
    return line | {
        "spread [mm]": f"{1e3 * rounds[-1].spread:.2f}",
        "sum of squares": f"{rounds[-1].squares:.0f}",
        "rounds": str(len(rounds)),
        "converged": "yes" if made.converged else "no",
        "CPU s": f"{seconds:.0f}",
    }


if __name__ == "__main__":
    parser = command_line(__doc__, "results/pinn_from_clouds.csv")
    parser.add_argument("--fabrics", nargs="+", choices=presets.FIVE, default=["grey_interlock"])
    parser.add_argument("--motions", nargs="+", default=["lifting+wind", "lifting", "wind"])
    a = parser.parse_args()
    jobs: list[Line] = [
        {"fabric": fabric, "motions": motions, "begins with": begin}
        for fabric in a.fabrics
        for motions in a.motions
        for begin in ("middle", "truth", "truth, held")
    ]
    resumed(a.out, CAPTION, jobs, lambda **job: found(*job.values()))
