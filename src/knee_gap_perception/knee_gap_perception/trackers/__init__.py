"""Rigid bodies from OptiTrack in every form a lab has it: topics, NatNet from Motive, exported takes."""
