"""Depth cameras: calibration, images to points, and rendered images.

- `camera`, `calibration`: which points are seen; lenses, poses, rays.
- `images`, `depth`, `timing`, `cleaning`: from files to points of the fabric.
- `rgbd`: folders of depth images and masks to recordings.
- `render`, `synthetic_rgbd`: images of a simulated sheet, with what real cameras get wrong.
"""
