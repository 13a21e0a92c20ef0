"""The fabric that the physics-informed network finds from clouds, beside the true one."""

import dataclasses
import time

import jax
import numpy as np
from _tables import Line

from r2s.estimation.pinn.from_clouds import Round, Settings, estimate
from r2s.fabrics import presets
from r2s.fabrics.parameters import OrthotropicSpace
from r2s.scenarios import lifting, synthetic, wind

MOTIONS = {"lifting": lifting, "wind": wind}
SHAPE = (17, 17)  # vertices of the sheet that is recorded
TOLD = ("warp", "weft", "shear", "coupling", "bending")  # the fit has neither friction nor damping


def found(fabric: str, motions: str, begin: str) -> Line:
    """The line of a table: one estimate."""
    truth = presets.FIVE[fabric]()
    space = OrthotropicSpace.make(float(truth.density))
    names = motions.split("+")
    keys = jax.random.split(jax.random.key(11), len(names))
    recordings = [
        synthetic.record(MOTIONS[name](), truth, fabric, shape=SHAPE, key=key)
        for name, key in zip(names, keys, strict=True)
    ]
    settings, rounds, is_held = Settings(), list[Round](), begin == "truth, held"
    if is_held:
        settings = dataclasses.replace(settings, held=settings.rounds)
    place = None if begin == "middle" else np.asarray(space.to_unit(truth))
    began = time.process_time()
    made = estimate(
        recordings, space, settings, begin=place, report=rounds.append, key=jax.random.key(0)
    )
    seconds = time.process_time() - began
    true = np.asarray(space.values(space.to_unit(truth)))
    line: Line = {}
    for bound, value, aim in zip(space.ranges, made.values, true, strict=True):
        if bound.name in TOLD:
            line[bound.name] = f"{value / aim:.2f}" if bound.log else f"{value - aim:+.2f}"
    return line | {
        "spread [mm]": f"{1e3 * rounds[-1].spread:.2f}",
        "sum of squares": f"{rounds[-1].squares:.0f}",
        "rounds": str(len(rounds)),
        "converged": "-" if is_held else "yes" if made.converged else "no",
        "CPU s": f"{seconds:.0f}",
    }
