"""`python -m knee_gap_uncertainty.studies.paper` is `study`."""

import sys

from knee_gap_uncertainty.studies.paper.command import main

if __name__ == "__main__":
    sys.exit(main())
