"""LINE.toml: one file that describes a line, for `open_line` and for `busmaster run`, `plan` and `emulate`."""

from __future__ import annotations

from busmaster.config.checking import Report, check
from busmaster.config.emulated import emulated_line, line_settings
from busmaster.config.line import ConfiguredLine, open_line
from busmaster.config.migrating import migration
from busmaster.config.sections import LineFile, load
from busmaster.config.source import FileError

__all__ = [
    "ConfiguredLine",
    "FileError",
    "LineFile",
    "Report",
    "check",
    "emulated_line",
    "line_settings",
    "load",
    "migration",
    "open_line",
]
