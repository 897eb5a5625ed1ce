"""`python -m tools` is `buddyline`."""

import sys

from tools.cli import main

sys.exit(main())
