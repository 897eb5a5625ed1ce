"""`python -m buddyline` is `buddyline`."""

import sys

from buddyline.tools.cli import main

sys.exit(main())
