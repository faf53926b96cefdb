"""What all tests share."""

import os

# A fault in the program is raised where it is, in the tests and in all processes that they start.
os.environ.setdefault("KNEE_GAP_STRICT", "1")
