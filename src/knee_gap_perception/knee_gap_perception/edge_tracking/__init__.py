"""Tracking of the two gap edges over a stream of images and lens poses."""
