"""Looks of a simulated knee: drawn from what arthroscopes show, instead of the plain renders."""
