"""All methods by name: what the command line and the study offer."""

from r2s.estimation.cma_es import CMAES
from r2s.estimation.diffcloud import DiffCloud, PublishedDiffCloud
from r2s.estimation.diffcp import DiffCP, PublishedDiffCP
from r2s.estimation.method import Method
from r2s.estimation.physnet.method import PhysNetMethod, PublishedPhysNet
from r2s.estimation.pinn.method import PINN, PublishedPINN

METHODS: dict[str, type[Method]] = {
    method.name: method
    for method in (
        DiffCloud,
        DiffCP,
        PhysNetMethod,
        PINN,
        CMAES,
        PublishedDiffCloud,
        PublishedDiffCP,
        PublishedPhysNet,
        PublishedPINN,
    )
}
