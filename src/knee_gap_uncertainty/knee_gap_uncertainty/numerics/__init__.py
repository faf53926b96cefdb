"""Vectors and small matrices for compiled kernels."""
