"""The command `report`: pages of what was measured in bags, for people to look at."""
