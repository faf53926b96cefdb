"""Values that pass between packages: poses, edges, estimates, rigid transforms."""
