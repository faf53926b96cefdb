"""The command `make_bag`: its arguments, and the simulated bag that it writes."""
