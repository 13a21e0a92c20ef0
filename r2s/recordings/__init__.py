"""Observations of a fabric, from files to one canonical form.

- `recording`: the canonical form: clouds, markers, force, the path of the grippers.
- `manifest`: what a folder of recordings is. `convert`: folders to NPZ files.
- `open`: a recording, or a simulated motion, from a path.
- `datasets`: public data.
- `readers`: one file format each. `cameras`: depth cameras, real and rendered.
"""
