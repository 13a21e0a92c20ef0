"""Tests of a textile laboratory, and the fabrics that they tell.

- `pull`: force and extension of strips. `cantilever`: overhangs (ASTM D1388). `drape`: drape
  coefficients (Cusick, BS EN ISO 9073-9), from a simulated specimen.
- `estimate`: the fabric that tests tell, and the space that knows of it.
- `files`: tests in a JSON file. `knits`: published pulls of knits.
"""
