"""Simulated bags: samples, metadata, ground truth."""
