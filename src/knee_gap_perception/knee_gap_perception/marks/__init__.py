"""Marks made by hand on real pictures, and the command `mark` that makes them."""
