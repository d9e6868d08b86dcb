"""Tells at once when something comes into a folder: a device node that is made, a link, a change of its rights.

Linux's inotify, read by the loop like a port. Where there is none (another system, a loop that reads no descriptors or
keeps a time of its own, no watch left for this user), the log says so once, and whoever waits looks by the clock.
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
"""Bytes of events that are read at once: what they say is not looked at."""


class FolderWatch:
    """Calls `on_change` when something comes into the folders that `follow` was told last. Raises OSError."""

    def __init__(self, loop: asyncio.AbstractEventLoop, on_change: Callable[[], None]) -> None:
        self._loop = loop
        self._on_change = on_change
        self._descriptor = call_system("inotify_init1", os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            loop.add_reader(self._descriptor, self._on_readable)
        except NotImplementedError:
            os.close(self._descriptor)
            raise OSError(f"a {type(loop).__name__} reads no descriptors") from None

    def follow(self, folders: Callable[[], tuple[str, ...]]) -> None:
        """Watch these folders too. Raises OSError where one cannot be watched.

        They are told again until nothing changes: what came between the question and the watch was not seen. A folder
        that is watched already stays so.
        """
        watched: set[str] = set()
        while new := set(folders()) - watched:
            for folder in new:
                with contextlib.suppress(FileNotFoundError, NotADirectoryError):  # then it is told otherwise next time
                    call_system("inotify_add_watch", self._descriptor, os.fsencode(folder), CHANGES)
            watched |= new

    def close(self) -> None:
        """Call nothing any more. The kernel takes some 10 ms to give the descriptor back: not on the loop."""
        self._loop.remove_reader(self._descriptor)
        in_own_thread(functools.partial(os.close, self._descriptor), "close inotify")

    def _on_readable(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.read(self._descriptor, READ_SIZE)
        self._on_change()


def watch_folders(
    watch: FolderWatch | None, folders: Callable[[], tuple[str, ...]], on_change: Callable[[], None]
) -> FolderWatch | None:
    """Have these folders watched, by this watch if there is one. None where that is not possible."""
    loop = asyncio.get_running_loop()
    if is_virtual(loop):
        return None
    try:
        watch = watch or FolderWatch(loop, on_change)
        watch.follow(folders)
    except OSError as error:
        tell_once(str(error))
        if watch is not None:
            watch.close()
        return None
    return watch


@cache
def tell_once(why: str) -> None:
    """Say in the log that ports which come back are noticed a little later."""
    logger.info("a port that comes back is looked for by the clock, since no folder can be watched: %s", why)
