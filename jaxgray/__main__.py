"""`python -m jaxgray`."""

import sys

from .cli import main

sys.exit(main())
