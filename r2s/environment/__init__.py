"""What a fabric meets: air, a table, and what grippers do.

- `air`: pressure of wind and still air on faces. `drag`: the same as forces on vertices.
- `contact`: normal pressure and Coulomb friction; a horizontal table.
- `scene`: what an experiment fixes, and the control at each step.
"""
