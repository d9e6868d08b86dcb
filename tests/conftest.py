"""What all tests share: hypothesis without a deadline, and the same examples every time where CI says so."""

from __future__ import annotations

import atexit
import os
import shutil
import signal
import tempfile

from hypothesis import settings

pytest_plugins = ["tests.transport.usb"]

settings.register_profile("busmaster", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True)
# Lines that tests serve are nobody else's, nor are those that others serve on this machine theirs.
os.environ["XDG_RUNTIME_DIR"] = tempfile.mkdtemp(prefix="busmaster-")
os.environ.pop("RUNTIME_DIRECTORY", None)
atexit.register(shutil.rmtree, os.environ["XDG_RUNTIME_DIR"], ignore_errors=True)

settings.load_profile("ci" if os.environ.get("CI") else "busmaster")

# A shell that starts a job in the background has it ignore these, and so would every command that the tests start and
# end by Ctrl-C. What a process handles is back at its default in those that it starts.
for number, handler in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGQUIT, signal.SIG_DFL),
    (signal.SIGHUP, signal.SIG_DFL),
):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)
