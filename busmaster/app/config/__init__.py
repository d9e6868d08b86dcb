"""LINE.toml: one file that describes a line, for `open_line` and for `busmaster run`, `plan` and `emulate`."""

from __future__ import annotations

from busmaster.app.config.emulated import emulated_line, line_settings
from busmaster.app.config.migrating import migration
from busmaster.app.config.sections import LineFile, load
from busmaster.app.config.source import FileError

__all__ = [
    "FileError",
    "LineFile",
    "emulated_line",
    "line_settings",
    "load",
    "migration",
]
