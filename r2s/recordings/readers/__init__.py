"""Readers, one file format each.

- `clouds`: point clouds. `force_log`: a load cell's log.
- `video`, `markers`, `plane`: printed dots in a video, in metres on the table.
- `numbered`: the numbered files of a folder.
"""
