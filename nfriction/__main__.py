"""`python -m nfriction`: the command line."""

import sys

from nfriction.cli import main

sys.exit(main())
