"""Recording a line while it runs, at no cost to it: the owner of the line only notes what passed, a thread writes.

It is a `Tap`: the owner of the line calls it on its loop, as soon as bytes have left or come and an attempt has ended.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType

from busmaster.arbiter.tap import Attempt
from busmaster.capture.assemble import Assembler
from busmaster.capture.files import COUNT, SIZE, CaptureFiles
from busmaster.capture.frames import Direction
from busmaster.capture.pcapng import Packet, PcapngWriter

CAPACITY = 50_000
"""Events that may wait for the disk: minutes of a line at 57600 baud."""
TICK = 0.05
"""Seconds between two looks of the writing thread, which is never woken by the line."""
SLICE = 10
"""Events handled before the thread lets go of the interpreter."""
PAUSE = 0.0002
RETRY = 1.0
"""Seconds from a failure to write to the next try."""
AT_ONCE = 1 << 16
"""Bytes that are written at once."""
IDLE = 3.0
"""Seconds without an event after which nothing is held back that is over: longer than any node needs to go on."""


class _Passed:
    """Bytes that were on the line. `attempt` is None, too, on one that is only listened to."""

    __slots__ = ("attempt", "data", "now", "sender")

    def __init__(self, now: float, data: bytes, sender: Direction, attempt: Attempt | None = None) -> None:
        self.now = now
        self.data = data
        self.sender = sender
        self.attempt = attempt


class Recorder:
    """A tap that writes a capture. Raises OSError if `path` cannot be written.

    A file that is there is never overwritten: `path` gets a number then, and so do those that follow when `size` bytes
    are in one; of its own the last `count` are kept (see `CaptureFiles`). While the disk is full, up to `capacity`
    events wait for it. `say` is told, from a thread, when that begins and when it is over.

    `port` names the line in the file; `protocol` is needed where nobody tells it (see `Assembler`); `echo` says that
    what is sent is received too. Close it off the loop: closing waits for the disk.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        port: str = "",
        protocol: str = "",
        echo: bool = False,
        capacity: int = CAPACITY,
        size: int = SIZE,
        count: int = COUNT,
        say: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.dropped = 0
        """Events that came while `capacity` of them waited, and those that the disk would not take to the end."""
        self.error: OSError | None = None
        """Why nothing can be written, while that is so."""
        self._capacity = capacity
        self._say = say
        self._events: deque[_Passed | Attempt] = deque()
        self._stop = threading.Event()
        self._port = port
        self._files = CaptureFiles(path, size=size, count=count)
        self._writer = PcapngWriter(self._files, port=port)
        self._unwritten = 0
        """Events that are made into packets, but not yet written."""
        self._reported = 0
        offset = time.time() - time.monotonic()
        self._assembler = Assembler(self._write, protocol=protocol, echo=echo, offset=offset)
        self._thread = threading.Thread(target=self._run, name="busmaster capture", daemon=True)
        self._thread.start()

    @property
    def path(self) -> str:
        """That of the file which is written now."""
        return self._files.path

    # on the loop that owns the line

    def transmitted(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        """Note what was handed to the port at `now`, in seconds of `time.monotonic()`."""
        self._note(_Passed(now, data, Direction.HOST, attempt))

    def received(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        """Note what came."""
        self._note(_Passed(now, data, Direction.NODE, attempt))

    def attempted(self, attempt: Attempt, /) -> None:
        """Note that an attempt is over."""
        self._note(attempt)

    def overheard(self, now: float, data: bytes) -> None:
        """Note bytes of a line that is only listened to: who sent them is worked out from what they say."""
        self._note(_Passed(now, data, Direction.UNKNOWN))

    def _note(self, event: _Passed | Attempt) -> None:
        if len(self._events) < self._capacity:
            self._events.append(event)
        else:
            self.dropped += 1

    # elsewhere

    def close(self) -> None:
        """Write what waits and close the file. It never raises, and may be called twice."""
        self._stop.set()
        self._thread.join()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    # on the thread

    def _run(self) -> None:
        busy = time.monotonic()
        while not self._stop.wait(TICK if self.error is None else RETRY):
            if self.error is not None:
                self._flush()
            elif self._events:
                busy = time.monotonic()
                self._drain()
            elif time.monotonic() - busy > IDLE:
                busy = time.monotonic()
                self._assembler.idle(busy)
                self._flush()
        self._end()

    def _end(self) -> None:
        """Write the rest, if the disk takes it."""
        self._flush()
        self._drain()
        self._assembler.finish(time.monotonic())
        self._writer.finish(round(time.time() * 1e6), self.dropped)
        try:
            self._files.close()
        except OSError as error:
            self.error = error
            self.dropped += self._unwritten
        self.dropped += len(self._events)
        self._events.clear()

    def _drain(self) -> None:
        """Write what waits in small helpings, so that the loop never waits long for the interpreter."""
        handled = 0
        while self._events and self.error is None:
            self._handle(self._events.popleft())
            self._unwritten += 1
            handled += 1
            if handled % SLICE == 0 and not self._stop.is_set():
                time.sleep(PAUSE)
            if self._files.full:
                self._begin_next()
            elif self._files.pending > AT_ONCE:
                self._flush()
        self._flush()

    def _flush(self) -> None:
        self._try(self._files.flush)

    def _begin_next(self) -> None:
        """Go on in a new file, between two events.

        Those of one exchange that is not over yet are all in the next file.
        """
        self._writer.finish(round(time.time() * 1e6), self.dropped)
        if self._try(self._files.begin_next):
            self._writer = PcapngWriter(self._files, port=self._port)

    def _try(self, work: Callable[[], None]) -> bool:
        """Return whether it could be written; say it when that changes."""
        try:
            work()
        except OSError as error:
            if self.error is None:
                self._say(f"the capture rests: {self.path}: {error.strerror}")
            self.error = error
            return False
        self._unwritten = 0
        if self.error is not None:
            self.error = None
            lost = f"{self.dropped} events are lost" if self.dropped else "nothing is lost"
            self._say(f"the capture goes on: {self.path}; {lost}")
        return True

    def _handle(self, event: _Passed | Attempt) -> None:
        if isinstance(event, Attempt):
            self._assembler.attempted(event)
        elif event.sender is Direction.UNKNOWN:
            self._assembler.overheard(event.now, event.data)
        else:
            self._assembler.passed(event.now, event.data, event.sender, event.attempt)

    def _write(self, packet: Packet) -> None:
        dropped = self.dropped
        packet.dropped = dropped - self._reported
        self._reported = dropped
        self._writer.write(packet)
