"""The physics of a cloth: laws and forces of one element or vertex, apart from how time is stepped.

- `membrane`: Green strain of a triangle, and the energy that a fabric stores in it.
- `bending`: the angle and curvature of a hinge, and the energy that a fabric stores in it.
- `table`: both, from measured tables that follow the strain.
- `contact`: normal pressure and Coulomb friction; the table.
- `proximity`: closest points of two pieces of a sheet, and when they meet.
- `air`: wind and still-air drag.
"""
