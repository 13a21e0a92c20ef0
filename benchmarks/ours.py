"""The cloth of r2s, set up for the benchmarks."""

from functools import partial

import equinox as eqx
import jax
import numpy as np
import scenes


def forward(size: int, substeps: int, damping: float, frames: int = scenes.FRAMES, **how):
    """The motion of "hang" with a damping time [s], compiled; `how`: see `scenes.hang`.

    A function of a factor on the membrane's stiffness; gives positions (frame, vertex, 3) [m].
    """
    return _forward(scenes.hang(size, substeps, frames, **how), damping)


def forward_explicit(size: int, finer: int, damping: float):
    """As `forward`, in explicit steps: `finer` times as many as are needed."""
    return _forward(scenes.explicit_hang(size, scenes.fabric(damping), finer=finer), damping)


def _forward(setting, damping: float):
    run = eqx.filter_jit(scenes.motion).lower(scenes.fabric(damping), *setting).compile()
    return lambda stiffness=1.0: np.asarray(run(scenes.fabric(damping, stiffness), *setting))


def gradient(size: int, substeps: int, damping: float, **how):
    """Loss [m^2] of "hang" and its gradient in the whole fabric, compiled.

    A function without arguments; gives the loss and its derivative [m^2] in a factor on the
    membrane's stiffness, which every system can be asked for.
    """
    setting = scenes.hang(size, substeps, **how)
    run = _value_and_gradient(scenes.fabric(damping), *setting)

    def call():
        value, slope = jax.block_until_ready(run(scenes.fabric(damping), *setting))
        law = slope.membrane
        slopes = (law.c11, law.c12, law.c22, law.c33)
        return float(value), sum(float(s) * c for s, c in zip(slopes, scenes.MEMBRANE, strict=True))

    return call


# as `forward` and `gradient`
forward_alpha = partial(forward, spectral_radius=0.6)
gradient_alpha = partial(gradient, spectral_radius=0.6)
forward_triangles = partial(forward, elements="rising")
gradient_triangles = partial(gradient, elements="rising")


def lift_gradient(size: int):
    """Loss [m^2] of "lift" and its gradient in the whole fabric, compiled; no arguments."""
    arguments = scenes.lift(size)
    run = _value_and_gradient(*arguments)
    return lambda: jax.block_until_ready(run(*arguments))


def _value_and_gradient(*arguments):
    function = eqx.filter_value_and_grad(scenes.motion_loss)
    return eqx.filter_jit(function).lower(*arguments).compile()
