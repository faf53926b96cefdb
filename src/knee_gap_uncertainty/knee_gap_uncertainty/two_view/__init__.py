"""The paper's method: gap and its range from two views."""
