"""What is estimated: a fabric, fabrics with provenance, and which numbers may vary.

- `fabric`: areal density, a membrane law, a bending law, damping, friction, thickness.
- `presets`: measured fabrics. `arcsim`: material files of ARCSim and DiffSim.
- `prior`: what one knows before a motion is seen.
- `parameters`: which numbers an estimator may move, and within which bounds.
"""
