"""Commands of `r2s`. `r2s.cli.main` puts them together.

A command is a dataclass, whose fields are its arguments, with a method `run` that gives the exit
code, or None for 0. What it needs is imported there, so that help comes at once.
"""
