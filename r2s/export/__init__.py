"""A fabric for other simulators, none of which it needs: their parameters, and what is lost."""
