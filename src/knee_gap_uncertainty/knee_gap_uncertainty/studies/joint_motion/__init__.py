"""Study of the joint motion test."""
