"""Tests of a textile laboratory, and the fabrics that explain them.

- `pull`: force and extension of strips. `bending`: cantilevers (ASTM D1388) and drapes (Cusick).
- `estimate`: the fabric that tests give, and the space with that as its prior.
- `files`: tests in a JSON file, and published pulls of knits.
"""
