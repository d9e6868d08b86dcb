"""The awaitable per-node handles, and by what name the command line and LINE.toml know them."""

from __future__ import annotations

from busmaster.handles.base import Handle

HANDLES: dict[str, type[Handle]] = {}
"""`--protocol P` -> the handle that speaks it."""

__all__ = ["HANDLES", "Handle"]
