"""Conversion of values from and to messages."""
