"""`python -m busmaster` is `busmaster`."""

from __future__ import annotations

import sys

from busmaster.app.cli import main

if __name__ == "__main__":
    sys.exit(main())
