"""Start-up of the suite: launch files, settings, the demo and an example leg controller."""
