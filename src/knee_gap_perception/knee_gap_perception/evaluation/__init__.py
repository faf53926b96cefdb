"""Error of predicted gap masks against marked ones."""
