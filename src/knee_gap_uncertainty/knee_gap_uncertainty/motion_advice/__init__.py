"""Advice where to move the scope."""
