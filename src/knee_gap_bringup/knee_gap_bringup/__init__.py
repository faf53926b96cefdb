"""Start-up of the suite: launch files, parameters, the demo and an example leg controller."""
