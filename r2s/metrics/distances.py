"""How far a simulation is from a recording: Chamfer and Hausdorff distance, in metres.

`paper_units` gives the study's normalised figures. These are for reports, in numpy: for something
to differentiate see `r2s.metrics.losses`.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

Cloud = Float[np.ndarray, "_ 3"]


def distances(real: Cloud, simulated: Cloud) -> dict[str, float]:
    """Distances [m] between two clouds of one frame.

    `chamfer_real_to_sim` and `chamfer_sim_to_real` are mean (not squared) distances to the nearest
    point, `chamfer` is the mean of the two, and `hausdorff` the largest nearest distance of both.
    Raises `ValueError` when a cloud is empty or not finite.

    >>> real, simulated = np.zeros((1, 3)), np.array([[0, 0, 0.01], [0, 0, 0.03]])
    >>> distances(real, simulated)["chamfer_real_to_sim"], distances(real, simulated)["hausdorff"]
    (0.01, 0.03)
    """
    to_simulated, to_real = _nearest(real, simulated)
    one, other = float(np.mean(to_simulated)), float(np.mean(to_real))
    return {
        "chamfer_real_to_sim": one,
        "chamfer_sim_to_real": other,
        "chamfer": (one + other) / 2,
        "hausdorff": float(max(np.max(to_simulated), np.max(to_real))),
    }


def paper_units(
    real: Cloud, simulated: Cloud, first_real: Cloud, first_simulated: Cloud
) -> dict[str, float]:
    """The study's figures for one frame, in its normalised units [-].

    Each cloud is centred on the centroid of its own first frame, divided by the largest radius
    there, and doubled. `paper_chamfer` is the mean squared nearest distance, both directions
    summed; `paper_hausdorff` the largest nearest distance.
    """
    to_simulated, to_real = _nearest(
        _normalised(real, first_real), _normalised(simulated, first_simulated)
    )
    return {
        "paper_chamfer": float(np.mean(to_simulated**2) + np.mean(to_real**2)),
        "paper_hausdorff": float(max(np.max(to_simulated), np.max(to_real))),
    }


def _normalised(cloud: Cloud, first: Cloud) -> Cloud:
    centre = first.mean(axis=0)
    radius = np.max(np.linalg.norm(first - centre, axis=1))
    if not radius > 0:
        raise ValueError("paper units need a first frame of more than one place")
    return 2 * (cloud - centre) / radius


def _nearest(a: Cloud, b: Cloud) -> tuple[np.ndarray, np.ndarray]:
    for name, cloud in (("first", a), ("second", b)):
        if cloud.ndim != 2 or cloud.shape[1] != 3 or not len(cloud):
            raise ValueError(f"the {name} cloud must be (point, 3), not empty, got {cloud.shape}")
        if not np.all(np.isfinite(cloud)):
            raise ValueError(f"the {name} cloud has coordinates that are not finite")
    return KDTree(b).query(a)[0], KDTree(a).query(b)[0]
