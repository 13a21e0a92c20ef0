"""Levels of all statistics."""

LEVEL = 0.9  # of every interval
SIGNIFICANCE = 0.05  # of every test
