"""Selection of points on tissue and their tracking from image to image."""
