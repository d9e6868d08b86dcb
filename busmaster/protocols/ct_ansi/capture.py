"""CT-ANSI with decimal points as a listener hears it: as Mentor II."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from busmaster.capture.frames import Frame, Kind
from busmaster.contract.exchange import Command
from busmaster.protocols.ct_ansi.codec import Read, ReadRun, Write
from busmaster.protocols.mentor.capture import STEPS, MentorDialect
from busmaster.protocols.mentor.codec import parse_parameter


class CtAnsiDialect(MentorDialect):
    """Frames are Mentor II's; commands are not."""

    def command(self, request: Frame, continued: Sequence[Frame], /) -> Command[Any]:
        menu, number = parse_parameter(request.item)
        if request.kind is Kind.READ:
            steps = [STEPS[short.command] for short in continued]
            if not steps or len(set(steps)) > 1:
                return Read(menu, number)
            return ReadRun(menu, number, 1 + len(steps), steps[0])
        text = request.value
        return Write(menu, number, bool(int(text)) if text in ("0", "1") else float(text))
