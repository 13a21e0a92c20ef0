"""Observations of a fabric, from files to one canonical form.

- `recording`: the canonical form: clouds, markers, force, the path of the grippers.
- `manifest`: what a folder of recordings is. `datasets`: public data.
- `open`: a recording, or a simulated motion, from a path; conversion of folders to NPZ.
- `clouds`, `force_log`, `markers`, `swings`, `images`: files of each kind.
- `cameras`, `views`, `rgbd`: depth images to clouds. `synthetic_rgbd`: rendered ones.
- `segmentation`: the cloth among the points of a whole scene.
- `checks`, `findings`: what is suspicious in a recording.
"""
