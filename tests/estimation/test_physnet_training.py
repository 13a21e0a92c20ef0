"""The embedding tells fabrics apart, and an interrupted training gives the same numbers."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r2s.estimation import checkpoint
from r2s.estimation.physnet import training
from r2s.estimation.physnet.dataset import DEPTH_UNIT, Data
from r2s.estimation.physnet.images import Flaws, View
from r2s.estimation.physnet.training import Architecture, Schedule

VIEW = View((0.0, -1.0, 0.0), (0.0, 0.0, 0.0), 16.0, 16, 0.5, 1.5, -1.0)
SMALL = Architecture(size=16, channels=(4, 4), hidden=(16,))
SHORT = Schedule(
    epochs=3, steps=20, fabrics=6, images=3, rate=3e-3, decay_every=2, validation=0.25,
    triplets=300, flaws=Flaws(1e-3, 0.1, 0.002, lost=0.0, gained=0.0, flying=0.0),
)  # fmt: skip


@pytest.fixture(autouse=True)
def promotion():
    """optax multiplies numbers of different kinds."""
    with jax.numpy_dtype_promotion("standard"):
        yield


@pytest.fixture(scope="module")
def data() -> Data:
    """Discs whose radius is that of the fabric, at the place that is the motion's."""
    generator = np.random.default_rng(0)
    radii = generator.uniform(1.5, 6, 16)
    rows, columns = np.mgrid[:16, :16]
    depth = np.zeros((64, 2, 16, 16), np.uint16)
    for motion in range(64):
        for frame in range(2):
            i, j = generator.uniform(6, 10, 2)
            disc = (rows - i) ** 2 + (columns - j) ** 2 < radii[motion // 4] ** 2
            depth[motion, frame] = np.where(disc, 1.0 / DEPTH_UNIT, 0)
    return Data(depth, np.arange(64) // 4, (radii[:, None] - 1.5) / 4.5)


def divided(data, needed=SHORT.fabrics):
    return training.split(data, SHORT.validation, needed, SHORT.seed)


@pytest.fixture(scope="module")
def trained(data):
    with jax.numpy_dtype_promotion("standard"):
        return training.train(training.begin(VIEW, SMALL, SHORT), data)


@pytest.mark.slow(group="physnet")
def test_the_embedding_tells_new_fabrics_apart(data, trained):
    _, validation = divided(data)
    untrained = training.begin(VIEW, SMALL, SHORT).network
    before = training.validate(untrained, VIEW, validation, SHORT)[1]
    assert trained.curve[-1].accuracy > 0.85 > before
    assert trained.curve[-1].loss < 0.7 * trained.curve[0].loss


@pytest.mark.slow(group="physnet")
def test_an_interrupted_training_gives_the_same_numbers(data, trained, tmp_path):
    path = tmp_path / "training.eqx"
    parts, rest = divided(data), []
    first = training.epoch(training.begin(VIEW, SMALL, SHORT), *parts)
    training.save(training.epoch(first, *parts), path)
    resumed = training.load(path)
    resumed = training.train(resumed, data, path, lambda number, row: rest.append(number))
    assert rest == [3]
    for one in (resumed, training.load(path)):
        assert one.curve == trained.curve and one.schedule == SHORT and one.view == VIEW
        same = jax.tree.map(np.array_equal, one.network, trained.network)
        assert all(jax.tree.leaves(eqx.filter(same, lambda leaf: isinstance(leaf, bool))))


def test_a_damaged_checkpoint_is_refused(trained, tmp_path):
    path = tmp_path / "training.eqx"
    training.save(trained, path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"training\.eqx is no checkpoint"):
        training.load(path)
    checkpoint.save(path, {"x": np.zeros(1)}, {"kind": "descent"})
    with pytest.raises(ValueError, match=r"training\.eqx: expected format r2s-physnet"):
        training.load(path)


def test_a_loss_that_is_not_finite_is_named(data):
    begun = training.begin(VIEW, SMALL, SHORT)
    slopes = jnp.full_like(begun.network.slopes, 1e200)
    wild = begun._replace(network=eqx.tree_at(lambda n: n.slopes, begun.network, slopes))
    with pytest.raises(FloatingPointError, match="loss is .* in epoch 0: lower the learning rate"):
        training.epoch(wild, *divided(data))


def test_a_fabric_is_for_training_or_for_validation(data):
    images, validation = divided(data)
    assert not set(images.fabric) & set(validation.fabric)
    assert set(images.fabric) | set(validation.fabric) == set(range(16))
    with pytest.raises(ValueError, match="16 fabrics, of which 4 are for validation"):
        divided(data, 13)


def test_triplets_are_of_two_motions_of_a_fabric_and_another(data):
    _, images = divided(data)
    anchor, positive, negative = training.triplets(images, 200, 0).T
    assert (images.fabric[anchor] == images.fabric[positive]).all()
    assert (images.motion[anchor] != images.motion[positive]).all()
    assert (images.fabric[anchor] != images.fabric[negative]).all()


def test_losses_of_three_points_on_a_line():
    points = jnp.array([[[0.0], [1.0]], [[3.0], [3.5]]])  # two fabrics, two images each
    squares = {(0, 2): 9, (0, 3): 12.25, (1, 2): 4, (1, 3): 6.25}
    near = {(0, 1): 1, (2, 3): 0.25}
    losses = []
    for pair, own in near.items():
        for anchor in pair:
            others = [v for k, v in squares.items() if anchor in k]
            losses += [max(own - other + 5, 0) for other in others]
    np.testing.assert_allclose(training.triplet_loss(points, 5.0), np.mean(losses))
