"""The life of a configured line: opening, poll groups, safe state, outputs, audit log, reloading, learned times."""

from __future__ import annotations

from busmaster.app.line.checking import Report, check
from busmaster.app.line.configured_line import ConfiguredLine, open_line

__all__ = ["ConfiguredLine", "Report", "check", "open_line"]
