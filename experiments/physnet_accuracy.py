"""Train PhysNet's network, and measure it on fabrics and a motion that it has never seen.

python experiments/physnet_accuracy.py --out results/physnet                 # 20 minutes, one core
python experiments/physnet_accuracy.py --scenario wind --out results/physnet_wind
python experiments/physnet_accuracy.py --fabrics 32 --unseen 16 --epochs 2 --calls 20   # a trial

Printed: the share of triplets of images that the network orders rightly (chance: one half), and for
each parameter the median error [share of its range] of estimates from clouds of unseen fabrics, and
of the nearest of as many simulations at random. What lies in OUT is not made again.
"""

import jax
import jax.numpy as jnp
import numpy as np
from _tables import Line, command_line, keep

from r2s.estimation.physnet import dataset, estimator, preprocess, training, triplets
from r2s.estimation.physnet.dataset import Settings
from r2s.scenarios import synthetic

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
    settings = Settings(a.scenario, a.fabrics)
    judged = Settings(a.scenario, a.unseen, num_levels=3, per_shard=a.unseen, seed=1)
    view = dataset.make(a.out / "data", settings).view
    dataset.make(a.out / "unseen", judged, view=view)
    taught, unseen = dataset.load(a.out / "data"), dataset.load(a.out / "unseen")
    schedule = training.Schedule(epochs=a.epochs)
    trained = training.train(training.begin(view, schedule=schedule), taught, a.out / "network.eqx")
    images = triplets.images_of(unseen, np.ones(len(unseen.fabric), bool))
    right = training.judge(trained.network, view, images, schedule)[1]
    experiment, space = dataset.levels(judged)[MOTION], judged.space
    frames = dataset.kept_frames(experiment.frames_used, judged.num_frames)
    errors, by_chance = [], []
    for number, place in enumerate(unseen.places[: a.estimates]):
        truth, key = space(jnp.asarray(place, float)), jax.random.key(number)
        seen = synthetic.record(experiment, truth, "unseen", shape=judged.shape, key=key)
        images = preprocess.of_clouds(view, seen, frames)
        scenario = experiment.scenario(judged.shape)
        sighting = estimator.Sighting.make(scenario, images, frames, space, trained)
        found = estimator.estimate(sighting, num_calls=a.calls, path=a.out / f"search_{number}.npz")
        errors.append(np.abs(np.asarray(space.to_unit(found.fabric)) - place))
        drawn = jax.random.uniform(key, (a.calls, space.dim), float)
        away = estimator.objective(sighting, a.calls)(np.asarray(drawn))
        by_chance.append(np.abs(np.asarray(drawn)[np.nanargmin(away)] - place))
    lines: list[Line] = [{"parameter": bound.name} for bound in space.ranges]
    for header, found in (("median error", errors), ("of random search", by_chance)):
        for line, value in zip(lines, np.median(found, axis=0), strict=True):
            line[header] = f"{value:.2f}"
    keep(a.out / "errors.csv", lines, f"{right:.1%} of triplets are ordered rightly.")
