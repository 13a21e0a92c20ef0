"""Tests of a textile laboratory, and the fabrics that explain them."""
