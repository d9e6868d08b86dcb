"""What all tests share: hypothesis without a deadline, and the same examples every time where CI says so."""

from __future__ import annotations

import os
import signal

from hypothesis import settings

pytest_plugins = ["tests.transport.usb"]

settings.register_profile("busmaster", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "busmaster")

# A shell that starts a job in the background has it ignore these, and so would every command that the tests start and
# end by Ctrl-C. What a process handles is back at its default in those that it starts.
for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)
