"""Reads captures of CT-ANSI with decimal points, like those of Mentor II."""

from __future__ import annotations

from busmaster.contract.exchange import Command
from busmaster.protocols.ct_ansi.codec import Read, ReadRun, Write
from busmaster.protocols.mentor.capture import MentorDialect


class CtAnsiDialect(MentorDialect):
    """Frames are Mentor II's; commands are not."""

    read = Read
    read_run = ReadRun

    def write(self, menu: int, number: int, text: str) -> Command[None]:
        return Write(menu, number, bool(int(text)) if text in ("0", "1") else float(text))
