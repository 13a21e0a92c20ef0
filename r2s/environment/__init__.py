"""What a fabric meets: air, a table, and what grippers do.

- `air`: wind and still air, as pressure on faces and as forces on vertices.
- `contact`: normal pressure and Coulomb friction; a horizontal table.
- `scene`: what an experiment fixes, and the control at each step.
"""
