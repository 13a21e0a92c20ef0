"""What could a map of a motion tell of a fabric if forces balanced in it but nearly?

python experiments/unbalanced_maps.py               # 15 CPU minutes

A physics-informed network fits a map and a fabric to clouds at once, and the map obeys the equation
of motion but nearly. Printed are the standard errors of the fabric (a share; of the coupling a
difference) that clouds leave beside such a map, by how large its unbalanced accelerations are.
Clouds see each vertex along its normal, by as many points as there are, and nothing else is wrong.
"""

import jax
import numpy as np
from _tables import Line, command_line, keep
from _unbalanced import known, linear

import r2s
from r2s.estimation.default_spaces import on_cloth

NOISE, POINTS = 1e-3, 3500  # of a point [m], and how many there are in a frame
SHARES = (0.0, 0.01, 0.1, 1.0)  # of gravity


def lines_of(name: str, scenario: str, side: int) -> list[Line]:
    """What clouds of a fabric in a scenario tell, on a mesh of side x side vertices."""
    fabric = r2s.presets.FIVE[name]()
    space = on_cloth(float(fabric.density))
    experiment = getattr(r2s, scenario)()
    motion = linear(experiment.scenario((side, side)), space, space.to_unit(fabric))
    precision, noise = np.asarray(space.prior()[1]), NOISE * side / np.sqrt(POINTS)
    widths = np.array([each.width for each in space.ranges])
    cases = [(share, lasts) for lasts in (False, True) for share in SHARES if share or not lasts]
    told = {}
    for share, lasts in [*cases, (np.inf, False)]:
        errors = np.sqrt(np.diag(np.linalg.inv(precision)))
        if np.isfinite(share):
            errors = known(motion, precision, noise, share, lasts)
        told[share, lasts] = errors * widths
    return [
        {"scenario": scenario, "fabric": name, "unbalanced [g]": f"{share:g}"}
        | {"in all frames": "alike" if lasts else "anew"}
        | {each.name: f"{e:.2g}" for each, e in zip(space.ranges, errors, strict=True)}
        for (share, lasts), errors in told.items()
    ]


if __name__ == "__main__":
    parser = command_line(__doc__, "results/unbalanced_maps.csv")
    fabrics = ("black_denim", "grey_interlock", "pink_solid")
    parser.add_argument("--fabrics", nargs="+", default=fabrics, choices=r2s.presets.FIVE)
    parser.add_argument("--scenarios", nargs="+", default=("lifting", "wind"))
    parser.add_argument("--side", type=int, default=5, help="vertices along a side, by default 5")
    a = parser.parse_args()
    jax.config.update("jax_enable_x64", True)  # differences of large covariances
    caption = "Standard errors that clouds leave beside a map in which forces balance but nearly."
    lines = []
    for scenario in a.scenarios:
        for fabric in a.fabrics:
            lines += lines_of(fabric, scenario, a.side)
            keep(a.out, lines, caption)
