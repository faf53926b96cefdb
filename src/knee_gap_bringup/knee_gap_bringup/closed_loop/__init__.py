"""The command `closed_loop`: the example controller opens a simulated knee until an instrument may pass."""
