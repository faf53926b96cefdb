"""The command `evaluate`: predicted gap masks compared with hand-marked or simulated ones."""
