"""`python -m knee_gap_uncertainty.study` is `study`."""

import sys

from knee_gap_uncertainty.study.command import main

if __name__ == "__main__":
    sys.exit(main())
