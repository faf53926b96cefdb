"""Segmentation of the dark gap: strategies with one interface, chosen by name."""
