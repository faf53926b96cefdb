"""OptiTrack's NatNet protocol: packets, session, clock, client."""
