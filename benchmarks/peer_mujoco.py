"""MuJoCo's flex in the scene "hang": the same membrane (Green strain) on the same mesh.

Its own masses are equal for all vertices; they are set to those of the areas, so that the model is
that of r2s but for the bending, and the two converge to the same motion.
"""

from functools import partial

import mujoco  # pyright: ignore[reportMissingImports]
import numpy as np
import scenes

from r2s.units import GRAVITY

mujoco.set_mju_user_warning(lambda message: None)  # or it writes a log file where it is run
MODEL = """
<mujoco>
  <option timestep="{step}" gravity="0 0 -{gravity}" integrator="{integrator}">
    <flag contact="disable"/>
  </option>
  <size memory="2G"/>
  <worldbody>
    <flexcomp name="cloth" type="direct" dim="2" dof="full" mass="{mass}" radius="1e-4"
        point="{points}" element="{faces}">
      <contact selfcollide="none" contype="0" conaffinity="0"/>
      <elasticity young="{young}" poisson="{poisson}" thickness="{thickness}" damping="{damping}"
          elastic2d="both"/>
      <pin id="0 {corner}"/>
    </flexcomp>
  </worldbody>
</mujoco>
"""


def _model(integrator: str, size: int, substeps: int, damping: float):
    mesh = scenes.sheet(size)

    def numbers(array):
        return " ".join(f"{number:.9g}" for number in np.asarray(array).ravel())

    model = mujoco.MjModel.from_xml_string(
        MODEL.format(
            step=1 / (60 * substeps),
            gravity=GRAVITY,
            integrator=integrator,
            mass=scenes.DENSITY * scenes.SIDE**2,
            points=numbers(scenes.flat(mesh)),
            faces=numbers(mesh.faces),
            young=scenes.YOUNGS_MODULUS,
            poisson=scenes.POISSONS_RATIO,
            thickness=scenes.THICKNESS,
            damping=damping,
            corner=size - 1,
        )
    )
    bodies = model.flex_vertbodyid
    free = bodies > 0  # the others belong to the world
    mass = scenes.DENSITY * np.asarray(mesh.vertex_area)[free]
    scale = mass / model.body_mass[bodies[free]]
    model.body_mass[bodies[free]] *= scale
    model.body_inertia[bodies[free]] *= scale[:, None]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _forward(integrator: str, size: int, substeps: int, damping: float):
    model = _model(integrator, size, substeps, damping)
    data = mujoco.MjData(model)

    def call():
        mujoco.mj_resetData(model, data)
        frames = []
        for _ in range(scenes.FRAMES):
            mujoco.mj_step(model, data, nstep=substeps)
            mujoco.mj_kinematics(model, data)  # positions lag by a step otherwise
            mujoco.mj_flex(model, data)
            frames.append(data.flexvert_xpos.copy())
        # a run that diverges is reset to its start
        done = abs(data.time - scenes.FRAMES / 60) < 1e-6
        return np.stack(frames) if done else np.full_like(frames, np.nan)

    return call


forward_implicit = partial(_forward, "discrete")  # linearly implicit, MuJoCo >= 3.13
forward_explicit = partial(_forward, "Euler")
