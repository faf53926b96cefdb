"""Study of wrong calibrations of the scope."""
