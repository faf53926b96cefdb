"""Launch plans: the processes of a launch, their order, and how it ends."""
