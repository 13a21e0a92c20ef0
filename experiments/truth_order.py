"""How large is a truth's own error, of which a finer mesh shows a part?

python experiments/truth_order.py --out docs/results/truth_order.csv      # half an hour

Truths of motions that have no horizon, on 33, 49 and 65 vertices a side, all from the shape in
which the first begins: mean distances between them over the motion. An error C n^-p in the cells n
a side leaves two such distances; these tell p, and the error itself beside what the first of them
shows, which is all that an ensemble has.
"""

from _tables import Line, command_line, resumed
from _truth_order import line

CAPTION = (
    "Mean distances [mm] between truths on meshes of so many vertices a side, the order of the "
    "error that they tell, and the error of 33 x 33."
)
MOTIONS = {
    "fling": ("grey_interlock", "red_jet_set"),
    "shaking": ("black_denim", "camel_ponte_roma", "pink_solid"),
}


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/truth_order.csv")
    a = parser.parse_args()
    jobs: list[Line] = [
        {"motion": motion, "fabric": fabric}
        for motion, fabrics in MOTIONS.items()
        for fabric in fabrics
    ]
    resumed(a.out, CAPTION, jobs, line)
