"""Surfaces of tissue: distances to them, their shading and textures."""
