"""`python -m shapeenh.cli`."""

import sys

from shapeenh.cli import main

sys.exit(main())
