"""What a study compares: configurations, evaluated on three motions that no estimate has seen."""

from typing import NamedTuple

APPROACHES = {"diffcloud": "DIFFCLOUD", "diffcp": "DiffCP", "physnet": "PhysNet", "pinn": "PINN"}
PUBLISHED = "-published"  # after an approach: by the recipe of its paper
AND = "+"  # between scenarios that are estimated from together
MOTIONS = ("folding", "fling", "shaking")
# baselines that are configurations as well, and what stands for an approach in their labels
REFERENCES = {"true": "true fabric on", "middle": "prior mean on"}
ON_CLOTH = "on_cloth"  # the baseline of estimates on material points that predict on the cloth


class Configuration(NamedTuple):
    """An approach on a solver that estimates from a scenario, or from several together.

    The default fabric on a solver is a configuration too, without approach and scenario.
    """

    approach: str
    solver: str
    estimated_from: str  # several: "lifting+stretching"

    @property
    def scenarios(self) -> tuple[str, ...]:
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
    """The configuration that stands for a baseline in tables; any other as it is."""
    if baseline in REFERENCES:
        return Configuration(REFERENCES[baseline], configuration.solver, "")
    if baseline == ON_CLOTH:
        return configuration._replace(approach=f"{_named(configuration.approach)} (found by MPM)")
    return configuration


def _named(approach: str) -> str:
    own = approach.removesuffix(PUBLISHED)
    return APPROACHES.get(own, own) + (" as published" if own != approach else "")


def is_reference(label: str) -> bool:
    """Whether a label is that of a fabric to compare with, not of an estimate."""
    return label.startswith(("default ", *(f"{name} " for name in REFERENCES.values())))


PAPER_CONFIGURATIONS = (
    Configuration("diffcloud", "cloth", "lifting"),
    Configuration("diffcloud", "cloth", "wind"),
    Configuration("diffcp", "mpm", "lifting"),
    Configuration("physnet", "cloth", "lifting"),
    Configuration("physnet", "cloth", "wind"),
    Configuration("physnet", "mpm", "lifting"),
    Configuration("pinn", "mpm", "stretching"),
    Configuration("pinn", "cloth", "stretching"),
)
"""The configurations in the tables of Ru et al. 2025, in their order."""

PUBLISHED_CONFIGURATIONS = tuple(
    c._replace(approach=c.approach + PUBLISHED) for c in PAPER_CONFIGURATIONS
)
"""The same by the recipes of the approaches' papers."""

TOGETHER_CONFIGURATIONS = tuple(
    Configuration("diffcloud", "cloth", estimated_from)
    for estimated_from in ("lifting+stretching", "lifting+wind+stretching+fling")
)
"""Several recordings of one fabric together, which the paper does not have: a lift and pulls in
three directions, also with a wind and a fling."""
