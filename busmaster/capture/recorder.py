"""Records a line while it runs, without delaying it: the line's owner only stores events, and a thread writes them.

It is a `Tap`: the owner of the line calls it on its loop, as soon as bytes were sent or received and an attempt has
ended.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType

from busmaster.capture.assemble import Assembler
from busmaster.capture.files import COUNT, SIZE, CaptureFiles
from busmaster.capture.pcapng import Packet, PcapngWriter
from busmaster.contract.frames import Direction
from busmaster.contract.tap import Attempt
from busmaster.transport.clock import TimeOfDay

CAPACITY = 50_000
"""Events that can wait for the disk: minutes of a line at 57600 baud."""
TICK = 0.05
"""Seconds between two checks of the writing thread. The line never wakes it."""
SLICE = 10
"""Events processed before the thread releases the interpreter."""
PAUSE = 0.0002
RETRY = 1.0
"""Seconds between two attempts to write after an error."""
AT_ONCE = 1 << 16
"""Bytes written at once."""
IDLE = 3.0
"""Seconds without an event after which all complete packets are written: longer than any node takes to continue."""


class _Passed:
    """Bytes on the line. `attempt` is None also on a line that is only listened to."""

    __slots__ = ("attempt", "data", "now", "sender")

    def __init__(self, now: float, data: bytes, sender: Direction, attempt: Attempt | None = None) -> None:
        self.now = now
        self.data = data
        self.sender = sender
        self.attempt = attempt


class Recorder:
    """A tap that writes a capture. Raises OSError if `path` cannot be written.

    Existing files are never overwritten: `path` gets a number then, and so do further files after `size` bytes. The
    last `count` files are kept (see `CaptureFiles`). While the disk is full, up to `capacity` events wait. `report` is
    called from a thread when that begins and ends.

    `port`: name of the line in the file. `protocol`: needed if nothing else determines it (see `Assembler`). `echo`:
    sent bytes are received too. Do not close it on the loop: closing waits for the disk.
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
        report: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.dropped = 0
        """Events lost because `capacity` events waited, and those that could not be written before the end."""
        self.error: OSError | None = None
        """The error while nothing can be written."""
        self._capacity = capacity
        self._report = report
        self._events: deque[_Passed | Attempt] = deque()
        self._stop = threading.Event()
        self._port = port
        self._files = CaptureFiles(path, size=size, count=count)
        self._writer = PcapngWriter(self._files, port=port)
        self._unwritten = 0
        """Events in packets that are not written yet."""
        self._file_ended = False
        """The file has its closing statistics, but the next one could not be created yet."""
        self._reported = 0
        self._time_of_day = TimeOfDay(time.monotonic)
        self._assembler = Assembler(self._write, protocol=protocol, echo=echo, offset=self._time_of_day.offset())
        self._thread = threading.Thread(target=self._run, name="busmaster capture", daemon=True)
        self._thread.start()

    @property
    def path(self) -> str:
        """Path of the current file."""
        return self._files.path

    # on the loop that owns the line

    def transmitted(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        """Store bytes passed to the port at `now`, in seconds of `time.monotonic()`."""
        self._note(_Passed(now, data, Direction.HOST, attempt))

    def received(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        """Store received bytes."""
        self._note(_Passed(now, data, Direction.NODE, attempt))

    def attempted(self, attempt: Attempt, /) -> None:
        """Store the end of an attempt."""
        self._note(attempt)

    def overheard(self, now: float, data: bytes) -> None:
        """Store bytes of a line that is only listened to. Their sender is inferred from the contents."""
        self._note(_Passed(now, data, Direction.UNKNOWN))

    def _note(self, event: _Passed | Attempt) -> None:
        if len(self._events) < self._capacity:
            self._events.append(event)
        else:
            self.dropped += 1

    # elsewhere

    def close(self) -> None:
        """Write the remaining events and close the file. Never raises, and can be called twice."""
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
                self._resume()
            elif self._events:
                busy = time.monotonic()
                self._drain()
            elif time.monotonic() - busy > IDLE:
                busy = time.monotonic()
                self._assembler.idle(busy)
                self._flush()
        self._end()

    def _end(self) -> None:
        """Write the remaining events if the disk accepts them."""
        # First: nothing is drained before a disk that was full accepts data again.
        if self.error is not None:
            self._resume()
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
        """Write waiting events in small batches, so that the loop never waits long for the interpreter."""
        self._assembler.offset = self._time_of_day.offset()  # the machine's clock may have been set
        handled = 0
        # While the disk is full the events stay in the queue, whose size is bounded.
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
        if self.error is None:
            self._flush()

    def _flush(self) -> None:
        self._try(self._files.flush)

    def _begin_next(self) -> None:
        """Continue in a new file, between two events.

        The events of an unfinished exchange are all in the next file.
        """
        if not self._file_ended:
            self._file_ended = True
            self._writer.finish(round(time.time() * 1e6), self.dropped)
        if self._try(self._files.begin_next):
            # each file has a header and can be read separately
            self._writer = PcapngWriter(self._files, port=self._port)
            self._file_ended = False

    def _resume(self) -> None:
        """Retry the failed step: a flush of the old file proves nothing about the next one."""
        if self._files.full:
            self._begin_next()
        else:
            self._flush()

    def _try(self, work: Callable[[], None]) -> bool:
        """Return True if writing succeeded. Reports changes."""
        try:
            work()
        except OSError as error:
            if self.error is None:
                self._report(f"the capture rests: {self.path}: {error.strerror}")
            self.error = error
            return False
        self._unwritten = 0
        if self.error is not None:
            self.error = None
            lost = f"{self.dropped} events are lost" if self.dropped else "nothing is lost"
            self._report(f"the capture goes on: {self.path}; {lost}")
        return True

    def _handle(self, event: _Passed | Attempt) -> None:
        if isinstance(event, Attempt):
            self._assembler.attempted(event)
        elif event.sender is Direction.UNKNOWN:
            self._assembler.overheard(event.now, event.data)
        else:
            self._assembler.passed(event.now, event.data, event.sender, event.attempt)

    def _write(self, packet: Packet) -> None:
        dropped = self.dropped  # read once: the loop continues to count
        packet.dropped = dropped - self._reported
        self._reported = dropped
        self._writer.write(packet)
