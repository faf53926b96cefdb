"""Simulated bags: samples, metadata and ground truth."""
