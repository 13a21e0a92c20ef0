#!/bin/sh
# scipy.optimize.lsq_linear (default method, "trf") takes matrices of single precision as long as the
# least squares solution without bounds lies within the bounds. Where a bound holds a number it raises
# "Buffer dtype mismatch, expected 'double' but got 'float'": with the same shapes and types, by the
# data alone. method="bvls" takes them always. JAX gives single precision by default.
#
# Seen with scipy 1.17.1, numpy 2.4.6.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q scipy==1.17.1 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
import scipy
from scipy.optimize import lsq_linear

matrix = np.array([[2.0, 1.0], [1.0, 3.0], [1.0, 0.0]], np.float32)
right = np.array([1.0, 2.0, 0.5], np.float32)
print("scipy", scipy.__version__)
free = lsq_linear(matrix, right, (-1.0, 1.0))
print("no bound holds:", free.x, free.x.dtype)
assert np.all(np.abs(free.x) < 1)
bounds = (-1.0, 0.3)  # below the second number
try:
    lsq_linear(matrix, right, bounds)
except ValueError as error:
    print("a bound holds:", error)
    assert "Buffer dtype mismatch" in str(error)
else:
    raise SystemExit("it has changed: single precision is taken where a bound holds")
print("bvls:", lsq_linear(matrix, right, bounds, method="bvls").x)
print("double:", lsq_linear(matrix.astype(float), right.astype(float), bounds).x)
PYTHON
