"""``python -m mvdyn_gtsam`` is ``mvdyn``."""

import sys

from mvdyn_gtsam.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
