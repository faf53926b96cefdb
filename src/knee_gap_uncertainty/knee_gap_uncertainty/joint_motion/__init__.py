"""Test whether the joint has moved during a track."""
