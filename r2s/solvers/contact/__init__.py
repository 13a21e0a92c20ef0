"""Contact of a sheet with itself.

- `broad_phase`: which parts of the sheet may meet, by boxes around what they sweep.
- `proximity`: closest points of two pieces of the sheet, and when they meet.
- `contacts`: planes that two places may not cross, and the steps that find them.
"""
