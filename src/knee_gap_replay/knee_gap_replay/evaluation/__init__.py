"""The command `evaluate`: predicted gap masks against marked or simulated ones."""
