"""Can what a coarse sheet fits be mapped to what the fabric is?

python experiments/coarse_map.py --draws 40 --out docs/results/coarse_map.csv    # half an hour

Draws of the prior are lifted on 33 x 33 vertices and estimated on fewer, from anywhere in the range
and with nothing known beforehand. Written for each parameter: the root mean square error of its
place in the range (0 to 1) in draws that were left out one by one, by the mean of the others, by
the fit as it is, and by linear maps of the fit.
"""

from pathlib import Path

from _coarse_map import fitted, judged
from _tables import command_line, keep, resumed

CAPTION = (
    "Root mean square errors over the ranges of draws that were left out: of the mean of the "
    "others, the fit of a coarse sheet, and linear maps of it."
)


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/coarse_map.csv")
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--shape", default="9", help="vertices a side")
    parser.add_argument("--fits", type=Path, default=Path("results/coarse_map_fits.csv"))
    a = parser.parse_args()
    jobs = [{"draw": str(draw), "shape": a.shape} for draw in range(a.draws)]
    fits = resumed(a.fits, "Draws and fits.", jobs, fitted)
    keep(a.out, judged(fits), CAPTION)
