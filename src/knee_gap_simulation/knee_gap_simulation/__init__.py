"""Simulated knees of known gap, with a simulated arthroscope and tracker."""
