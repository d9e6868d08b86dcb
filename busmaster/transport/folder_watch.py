"""Reports at once that an entry of a folder was created or changed: a device node, a link, its rights.

It uses Linux's inotify, which the loop reads like a port. If that is not available, this is logged once, and callers
poll. It is not available on another system, with a loop that cannot read descriptors or has a virtual clock, and if the
user has no watch left.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import os
from collections.abc import Callable
from functools import cache

from busmaster.transport.alarm import call_system
from busmaster.transport.clock import is_virtual
from busmaster.transport.own_thread import in_own_thread

logger = logging.getLogger("busmaster")

IN_ATTRIB, IN_MOVED_TO, IN_CREATE, IN_ONLYDIR = 0x4, 0x80, 0x100, 0x1000000
IN_DELETE_SELF, IN_MOVE_SELF = 0x400, 0x800
CHANGES = IN_CREATE | IN_MOVED_TO | IN_ATTRIB | IN_DELETE_SELF | IN_MOVE_SELF | IN_ONLYDIR
"""linux/inotify.h. IN_ATTRIB: udev gives a node its group after the kernel has made it."""
READ_SIZE = 65536
"""Bytes of events that are read at once. Their content is not used."""


class FolderWatch:
    """Calls `on_change` when an entry appears in a folder of the last `follow`. Raises OSError."""

    def __init__(self, loop: asyncio.AbstractEventLoop, on_change: Callable[[], None]) -> None:
        self._loop = loop
        self._on_change = on_change
        # By ctypes: Python has no inotify, and a package for three system calls is not worth a dependency.
        self._descriptor = call_system("inotify_init1", os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            loop.add_reader(self._descriptor, self._on_readable)
        except NotImplementedError:
            os.close(self._descriptor)
            raise OSError(f"a {type(loop).__name__} cannot read descriptors") from None

    def follow(self, folders: Callable[[], tuple[str, ...]]) -> None:
        """Watch these folders too. Raises OSError where one cannot be watched.

        `folders` is called again until its result does not change: an entry that appears between the call and the
        beginning of the watch would be missed. Folders of earlier calls are still watched.
        """
        watched: set[str] = set()
        while new := set(folders()) - watched:
            for folder in new:
                with contextlib.suppress(FileNotFoundError, NotADirectoryError):  # the next `follow` names another one
                    call_system("inotify_add_watch", self._descriptor, os.fsencode(folder), CHANGES)
            watched |= new

    def close(self) -> None:
        """Stop. The kernel takes some 10 ms to close the descriptor, so that is not done on the loop."""
        self._loop.remove_reader(self._descriptor)
        in_own_thread(functools.partial(os.close, self._descriptor), "close inotify")

    def _on_readable(self) -> None:
        with contextlib.suppress(BlockingIOError):
            # The names in the events are not used: `presence` is the only judge of whether the device is back.
            os.read(self._descriptor, READ_SIZE)
        self._on_change()


def watch_folders(
    watch: FolderWatch | None, folders: Callable[[], tuple[str, ...]], on_change: Callable[[], None]
) -> FolderWatch | None:
    """Watch these folders, with this watch if there is one. Return None where that is not possible."""
    loop = asyncio.get_running_loop()
    if is_virtual(loop):
        return None
    try:
        watch = watch or FolderWatch(loop, on_change)
        watch.follow(folders)
    except OSError as error:
        warn_once(str(error))
        if watch is not None:
            watch.close()
        return None
    return watch


@cache
def warn_once(why: str) -> None:
    """Log that a port which comes back is noticed a little later."""
    logger.info("polling for ports that come back, because folders cannot be watched: %s", why)
