"""What the rows of a study say.

- `result_array`: the rows of a metric as an array, and its bootstrap.
- `distances`, `ranks`, `factors`, `recordings`, `parameters`, `paper`: tables of them.
- `hypotheses`, `conclusions`, `findings`: which conclusions of the paper hold.
"""
