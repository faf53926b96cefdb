"""Client of OptiTrack's NatNet protocol: packets, session, clock, sockets."""
