"""`python -m workflows.cli` is `gnmreg`."""

import sys

from workflows.cli.app import main

sys.exit(main())
