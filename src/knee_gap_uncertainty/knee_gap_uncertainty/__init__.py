"""How wide the instrument gap is, and how sure that is."""
