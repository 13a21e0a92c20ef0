"""What a study compares: configurations, judged on three motions that no estimate has seen."""

from typing import NamedTuple

APPROACHES = {"diffcloud": "DIFFCLOUD", "diffcp": "DiffCP", "physnet": "PhysNet", "pinn": "PINN"}
PUBLISHED = "-published"  # behind an approach: by the recipe of its paper, as it is
AND = "+"  # between scenarios that are estimated from together
MOTIONS = ("folding", "fling", "shaking")  # that no estimate has seen
# baselines that are configurations as well, and what stands for an approach in their labels
REFERENCES = {"true": "true fabric on", "middle": "middle of the prior on"}
# the baseline of what an estimate on material points predicts on the cloth, as all others do
ON_CLOTH = "on_cloth"


class Configuration(NamedTuple):
    """An approach on a solver that estimates from a scenario, or from several together.

    The default fabric on a solver is a configuration too, without approach and scenario.
    """

    approach: str
    solver: str
    estimated_from: str  # several: "lifting+stretching"

    @property
    def scenarios(self) -> tuple[str, ...]:
        """What it estimates from."""
        return tuple(self.estimated_from.split(AND))

    @property
    def label(self) -> str:
        if not self.approach:
            return f"default {self.solver}"
        return f"{_named(self.approach)} {self.solver} {self.estimated_from}".strip()

    @property
    def is_published(self) -> bool:
        """Whether it is by the recipe of the approach's paper."""
        return self.approach.endswith(PUBLISHED)


def as_configuration(configuration: Configuration, baseline: str) -> Configuration:
    """What a table calls a baseline that is a line of its own; any other as it is."""
    if baseline in REFERENCES:
        return Configuration(REFERENCES[baseline], configuration.solver, "")
    words = {"other_fabric": "of another fabric", ON_CLOTH: "found on points"}.get(baseline)
    if words is None:
        return configuration
    return configuration._replace(approach=f"{_named(configuration.approach)} ({words})")


def _named(approach: str) -> str:
    """An approach in words; what is none, as it is."""
    own = approach.removesuffix(PUBLISHED)
    return APPROACHES.get(own, own) + (" as published" if own != approach else "")


def is_reference(label: str) -> bool:
    """Whether a label is that of no estimate, but of a fabric to compare with, on a solver."""
    return label.startswith(("default ", *(f"{name} " for name in REFERENCES.values())))


PAPER_CONFIGURATIONS = (
    Configuration("diffcloud", "cloth", "lifting"),
    Configuration("diffcloud", "cloth", "wind"),
    Configuration("diffcp", "points", "lifting"),
    Configuration("physnet", "cloth", "lifting"),
    Configuration("physnet", "cloth", "wind"),
    Configuration("physnet", "points", "lifting"),
    Configuration("pinn", "points", "stretching"),
    Configuration("pinn", "cloth", "stretching"),
)
"""The configurations in the tables of Ru et al. 2025, in their order."""

PUBLISHED_CONFIGURATIONS = tuple(
    each._replace(approach=each.approach + PUBLISHED) for each in PAPER_CONFIGURATIONS
)
"""The same by the recipes of the approaches' papers, to compare with."""

TOGETHER_CONFIGURATIONS = tuple(
    Configuration("diffcloud", "cloth", AND.join(each))
    for each in (("lifting", "stretching"), ("lifting", "wind", "stretching", "fling"))
)
"""What the paper does not have: a lift and pulls in three directions, or these with a wind and a
fling, of one fabric together."""
