"""Materials of a sheet: a fabric, the laws of its energies, and spaces of fabrics.

- `membrane`, `bending`, `plate`, `stiffening`, `tables`, `wrinkling`, `solid`: energies of one
  element.
- `fabric`: the laws of one fabric with its density, damping and friction; `presets`: measured ones.
- `parameters`: from numbers that an estimate searches to a fabric, and spaces that add some;
  `prior`: what is known of them beforehand.
- `fabric_json`, `arcsim`: files of a fabric.
"""
