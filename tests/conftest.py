"""What all tests share: hypothesis without a deadline, and the same examples every time where CI says so."""

from __future__ import annotations

import os

from hypothesis import settings

pytest_plugins = ["tests.transport.usb"]

settings.register_profile("busmaster", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "busmaster")
