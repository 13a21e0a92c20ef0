"""DiffSim's runs as truths: does a fabric that is estimated from one predict the other?

python experiments/diffsim_truths.py --data FOLDER --out docs/results/diffsim_truths.csv   # minutes

Two fabrics of Wang et al. 2011, each lifted at a corner and hung in wind, by DiffSim (Qiao et al.
2020) on 9 x 9 vertices. A fabric is estimated by DIFFCLOUD from clouds of the first 0.4 s of one
motion, and judged in the whole other one up to its horizon, beside the fabric's own tables on the
same mesh and step, and draws of the prior. FOLDER has the runs as `r2s.study.diffsim_runs` reads
them. Estimates are kept in --folder.
"""

import tempfile
from pathlib import Path

from _diffsim import FABRICS, MOTIONS, SEEN, estimate, line
from _tables import Line, command_line, resumed

import r2s

CAPTION = (
    "Mean distances [mm] of DiffSim's sheet of 1 m from the prediction, up to the horizon: floor "
    "of the run and its causes, DiffSim's own tables on our cloth, estimates from the other motion "
    "and from the same one, and draws of the prior (mean, least to most). What fabrics differ by: "
    "over the whole run."
)


def fabric_from(data: Path, kept: Path, motion: str, fabric: str) -> r2s.Fabric:
    """The fabric of a card; it is estimated where there is none."""
    card = kept / f"{fabric}_{motion}.json"
    if not card.exists():
        found = estimate(data, motion, fabric)
        kept.mkdir(parents=True, exist_ok=True)
        method = f"estimated by {found.approach} from the first {SEEN} frames of DiffSim's {motion}"
        r2s.write_card(card, r2s.Card.make(fabric, found, r2s.Provenance(method)))
    return r2s.read_card(card).fabric


def judged(data: Path, kept: Path, fabric: str, judged_in: str) -> Line:
    """The line of a run."""
    (other,) = (motion for motion in MOTIONS if motion != judged_in)
    sources = {"estimate, other motion": other, "estimate, same motion": judged_in}
    estimates = {name: fabric_from(data, kept, each, fabric) for name, each in sources.items()}
    with tempfile.TemporaryDirectory() as scratch:
        return line(data, judged_in, fabric, estimates, Path(scratch))


if __name__ == "__main__":
    parser = command_line(__doc__, "results/diffsim_truths.csv")
    parser.add_argument("--data", type=Path, required=True, help="folder of DiffSim's runs")
    parser.add_argument("--folder", type=Path, default=Path("results/diffsim"), help="of estimates")
    a = parser.parse_args()
    jobs = [{"fabric": fabric, "judged in": motion} for fabric in FABRICS for motion in MOTIONS]

    def make(**job: str) -> Line:
        return judged(a.data, a.folder, job["fabric"], job["judged in"])

    resumed(a.out, CAPTION, jobs, make)
