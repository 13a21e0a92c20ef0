"""Does the physics-informed network find a fabric from clouds of one or several motions together?

python experiments/pinn_from_clouds.py     # an hour

Clouds are of our own sheet of 17 x 17 vertices. The fit begins with the middle of the range, which
is knowing nothing, or with the true fabric; or the true fabric is held, and the maps alone are
fitted. Printed: the fabric over the truth (coupling: the difference), the spread of the distances
of points from the maps, and the sum of the squares of all residuals.
"""

from _pinn_from_clouds import found
from _tables import Line, command_line, resumed

from r2s.fabrics import presets

CAPTION = (
    "What clouds lead the network to, over the true fabric (coupling: difference). Spread: of the "
    "distances of points from the maps (1.48 times the median), before the last steps. Truth, "
    "held: the true fabric is held in all rounds, and the maps alone are fitted."
)


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/pinn_from_clouds.csv")
    parser.add_argument("--fabrics", nargs="+", choices=presets.FIVE, default=["grey_interlock"])
    parser.add_argument("--motions", nargs="+", default=["lifting+wind", "lifting", "wind"])
    a = parser.parse_args()
    jobs: list[Line] = [
        {"fabric": fabric, "motions": motions, "begin": begin}
        for fabric in a.fabrics
        for motions in a.motions
        for begin in ("middle", "truth", "truth, held")
    ]
    resumed(a.out, CAPTION, jobs, found)
