"""Studies of the method: the paper's tables, coverage, joint motion, wrong calibrations."""
