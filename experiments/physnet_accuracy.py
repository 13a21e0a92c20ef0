"""Train PhysNet's network, and measure it on fabrics and a motion that it has never seen.

python experiments/physnet_accuracy.py --out results/physnet                 # 20 minutes, one core
python experiments/physnet_accuracy.py --scenario stretching --out results/stretching  # an hour
python experiments/physnet_accuracy.py --fabrics 32 --unseen 16 --epochs 2 --calls 20   # a trial

Printed: the share of triplets of images that the network orders rightly (chance: one half), and for
each parameter the median error [share of its range] of estimates from clouds of unseen fabrics, and
of the nearest of as many simulations at random. Of a stretching the force counts, too. What lies in
OUT is not made again.
"""

import numpy as np
from _physnet_accuracy import errors
from _tables import Line, command_line, keep

from r2s.estimation.default_spaces import RANGES
from r2s.estimation.physnet import dataset, training, triplets
from r2s.estimation.physnet.dataset import Settings

MOTION = 1  # the number of a motion that no training data have

if __name__ == "__main__":
    parser = command_line(__doc__, "results/physnet")
    parser.add_argument("--scenario", default="lifting")
    parser.add_argument("--fabrics", type=int, default=512)
    parser.add_argument("--unseen", type=int, default=128)
    parser.add_argument("--epochs", type=int, default=training.Schedule.epochs)
    parser.add_argument("--calls", type=int, default=80, help="simulations of a search")
    parser.add_argument("--estimates", type=int, default=8)
    a = parser.parse_args()
    settings = Settings(a.scenario, a.fabrics, ranges=RANGES)
    of_judged = {"num_levels": 3, "per_shard": a.unseen, "seed": 1}
    judged = Settings(a.scenario, a.unseen, ranges=RANGES, **of_judged)
    view = dataset.make(a.out / "data", settings).view
    dataset.make(a.out / "unseen", judged, view=view)
    taught, unseen = dataset.load(a.out / "data"), dataset.load(a.out / "unseen")
    schedule = training.Schedule(epochs=a.epochs)
    trained = training.train(training.begin(view, schedule=schedule), taught, a.out / "network.eqx")
    images = triplets.images_of(unseen, np.ones(len(unseen.fabric), bool))
    right = training.judge(trained.network, view, images, schedule)[1]
    experiment = dataset.levels(judged)[MOTION]
    found = [
        errors(trained, judged, experiment, place, number, a.calls, a.out)
        for number, place in enumerate(unseen.places[: a.estimates])
    ]
    medians = {name: np.median([each[name] for each in found], axis=0) for name in found[0]}
    lines: list[Line] = [
        {"parameter": bound.name} | {name: f"{of[i]:.2f}" for name, of in medians.items()}
        for i, bound in enumerate(judged.space.ranges)
    ]
    keep(a.out / "errors.csv", lines, f"{right:.1%} of triplets are ordered rightly.")
