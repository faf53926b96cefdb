"""Surfaces of tissue: distance fields, shading, textures, and the instrument gap between them."""
