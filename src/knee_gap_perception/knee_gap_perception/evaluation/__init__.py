"""Errors of predicted gap masks compared with marked ones."""
