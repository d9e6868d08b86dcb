"""A passive decoder: separates the traffic of a line into frames and describes them.

It receives both directions mixed and mostly without the sender, so it cannot use the master's readers. Frames are
separated by position, because any byte may be a checksum. After a silence an incomplete frame is given up.
"""

from __future__ import annotations

from busmaster.contract.frames import Dialect, Direction, Frame, Kind

LONGEST_FRAME = 250
DEFAULT_GAP = 0.1
"""Seconds of silence that end an incomplete frame: longer than any adapter's buffering, shorter than a retry."""


class Decoder:
    """Converts bytes with times to frames. `gap`: seconds of silence that end an incomplete frame."""

    def __init__(self, dialect: Dialect, *, gap: float = DEFAULT_GAP) -> None:
        self._dialect = dialect
        self._gap = gap
        self._buffer = bytearray()
        self._rejected = bytearray()
        self._rejected_at = 0.0
        self._rejected_joined = False
        self._joined = False
        """The bytes in the buffer arrived in one piece with the bytes before them."""
        self._started = 0.0
        self._heard = 0.0
        self._last_end = 0.0
        self._sender = Direction.UNKNOWN

    def feed(self, data: bytes, now: float, sender: Direction = Direction.UNKNOWN) -> list[Frame]:
        """Process the next bytes, received at `now` in seconds. A change of a known `sender` ends an incomplete
        frame."""
        frames = self.quiet() if now - self._heard > self._gap or sender is not self._sender else []
        if not self._buffer:
            self._started = now
            self._joined = False
        self._buffer += data
        self._heard = now
        self._sender = sender
        self._cut(frames)
        return frames

    def quiet(self) -> list[Frame]:
        """End an incomplete frame: the line was silent for the gap, or another sender began."""
        frames: list[Frame] = []
        self._cut(frames, quiet=True)
        self._flush(frames)
        return frames

    @property
    def unfinished(self) -> bool:
        """Return True if bytes wait for more bytes or for silence."""
        return bool(self._buffer or self._rejected)

    def _cut(self, frames: list[Frame], *, quiet: bool = False) -> None:
        while self._buffer:
            size = self._dialect.size(bytes(self._buffer), self._sender, quiet=quiet)
            if size == 0:
                return
            raw = bytes(self._buffer[: abs(size)])
            del self._buffer[: abs(size)]
            if size < 0:
                self._reject(raw, frames)
            else:
                self._flush(frames)
                frames.append(self._timed(self._dialect.explain(raw, self._sender)))
            self._started = self._heard
            self._joined = bool(self._buffer)

    def _timed(self, frame: Frame) -> Frame:
        frame.time = self._started
        frame.ended = self._heard
        frame.joined = self._joined
        if frame.answers:
            frame.delay = self._started - self._last_end
        if frame.sender is Direction.HOST or frame.answers:
            self._last_end = self._heard
        return frame

    def _reject(self, raw: bytes, frames: list[Frame]) -> None:
        if len(self._rejected) + len(raw) > LONGEST_FRAME:
            self._flush(frames)
        if not self._rejected:
            self._rejected_at = self._started
            self._rejected_joined = self._joined
        self._rejected += raw

    def _flush(self, frames: list[Frame]) -> None:
        """Return unreadable bytes as a frame of their own."""
        if not self._rejected:
            return
        raw = bytes(self._rejected)
        self._rejected.clear()
        fault = f"cut short after {len(raw)} bytes" if raw[0] in self._dialect.starts and len(raw) > 1 else "no frame"
        frames.append(
            Frame(
                Kind.NOISE,
                self._sender,
                raw,
                fault=fault,
                joined=self._rejected_joined,
                time=self._rejected_at,
                ended=self._heard,
            )
        )


__all__ = [
    "DEFAULT_GAP",
    "LONGEST_FRAME",
    "Decoder",
]
