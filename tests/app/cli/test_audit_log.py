"""The audit log on standard error: each once, by how much it matters, and never in the line's way."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator

import pytest

from busmaster.app.cli import audit_log
from busmaster.app.cli.audit_log import NAME, AuditLog
from busmaster.app.cli.output import Level
from busmaster.app.service.authorisation import Authorisation, WriteRequest
from busmaster.bus.bus import Bus
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort
from busmaster.errors import NoReply, WriteUnconfirmed
from busmaster.protocols.hcp2.handle import Hcp2Controller
from tests.patience import PATIENCE


@pytest.fixture
def authorisation() -> Authorisation:
    return Authorisation(Bus(MemoryPort(Line(Hcp2Controller.profile.line))))


class Printed:
    """What was printed. It takes no line unless it `goes_on`."""

    def __init__(self) -> None:
        self.lines: list[tuple[str, Level]] = []
        self.began = threading.Event()
        self.goes_on = threading.Event()
        self.goes_on.set()

    def note(self, line: str, level: Level = Level.INFO) -> None:
        self.began.set()
        assert self.goes_on.wait(PATIENCE)
        self.lines.append((line, level))


@pytest.fixture
def printed(monkeypatch: pytest.MonkeyPatch) -> Iterator[Printed]:
    printed = Printed()
    monkeypatch.setattr(audit_log, "note", printed.note)
    monkeypatch.setattr(audit_log, "CLOSE_WITHIN", PATIENCE)
    yield printed
    printed.goes_on.set()  # the thread ends, whatever the test did


def write(authorisation: Authorisation, name: str, error: BaseException | None = None) -> None:
    authorisation.begin(
        WriteRequest(interface="mqtt", by="line/set/" + name, name=name, point=None, value=7, id="a1")
    ).end(error)


def test_each_write_is_a_line_and_one_that_is_unconfirmed_a_warning(
    authorisation: Authorisation, printed: Printed
) -> None:
    write(authorisation, "before")
    with AuditLog(lambda: True):
        write(authorisation, "5/1")
        write(authorisation, "5/2", NoReply("no reply within 100 ms"))
        write(authorisation, "5/3", WriteUnconfirmed("no reply within 100 ms"))
    write(authorisation, "behind")
    assert [(line.split(" in ")[0], level) for line, level in printed.lines] == [
        ("audit: 5/1 = 7 written", Level.INFO),
        ("audit: 5/2 = 7 not started", Level.INFO),
        ("audit: 5/3 = 7 unconfirmed", Level.WARNING),
    ]
    assert " by mqtt line/set/5/1 [a1], " in printed.lines[0][0]


def test_nothing_is_printed_into_a_picture(authorisation: Authorisation, printed: Printed) -> None:
    drawn = True
    with AuditLog(lambda: not drawn):
        write(authorisation, "5/1")
        drawn = False
        write(authorisation, "5/2")
    assert [line.split()[1] for line, _ in printed.lines] == ["5/2"]


def test_a_standard_error_that_takes_nothing_holds_up_nobody_and_what_is_lost_is_told(
    authorisation: Authorisation, printed: Printed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(audit_log, "MOST_WAITING_ENTRIES", 3)
    printed.goes_on.clear()
    with AuditLog(lambda: True):
        write(authorisation, "5/0")
        assert printed.began.wait(PATIENCE)  # it is in the thread's hands, and waits no more
        for number in range(1, 6):
            write(authorisation, f"5/{number}")
        printed.goes_on.set()
    assert [line.split()[1] for line, _ in printed.lines[:-1]] == ["5/0", "5/1", "5/2", "5/3"]
    assert printed.lines[-1] == ("audit: 2 writes are not listed here; standard error was blocked", Level.WARNING)


def test_each_loss_is_reported_once_with_its_own_number(
    authorisation: Authorisation, printed: Printed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(audit_log, "MOST_WAITING_ENTRIES", 1)
    monkeypatch.setattr(audit_log, "TICK", 0.001)
    with AuditLog(lambda: True):
        for lost in (2, 1):
            seen = len(printed.lines)
            printed.began.clear()
            printed.goes_on.clear()
            write(authorisation, "5/0")
            assert printed.began.wait(PATIENCE)
            for _ in range(lost + 1):
                write(authorisation, "5/1")
            printed.goes_on.set()
            while len(printed.lines) < seen + 3:
                time.sleep(0.001)
    said = [line for line, _ in printed.lines if "not listed" in line]
    assert [line.split()[1] for line in said] == ["2", "1"]


def test_a_loss_just_before_the_end_is_reported(
    authorisation: Authorisation, printed: Printed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(audit_log, "MOST_WAITING_ENTRIES", 1)
    monkeypatch.setattr(audit_log, "TICK", PATIENCE)  # the thread waits for the end
    with AuditLog(lambda: True):
        for number in range(3):
            write(authorisation, f"5/{number}")
    first, lost = (line for line, _ in printed.lines)
    assert first.startswith("audit: 5/0 = 7 ")
    assert lost.startswith("audit: 2 writes are not listed here")


def test_a_standard_error_that_stays_blocked_does_not_hold_up_the_end(
    authorisation: Authorisation, printed: Printed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(audit_log, "CLOSE_WITHIN", 0.01)
    printed.goes_on.clear()
    with AuditLog(lambda: True):
        write(authorisation, "5/0")
        assert printed.began.wait(PATIENCE)
        [thread] = (thread for thread in threading.enumerate() if thread.name == "busmaster audit log")
    assert thread.is_alive()
    assert thread.daemon, "else the interpreter would wait for it"
    printed.goes_on.set()
    thread.join(PATIENCE)


def test_the_log_is_as_before_when_it_has_ended() -> None:
    log = logging.getLogger(NAME)
    before = log.level, list(log.handlers)
    with AuditLog(lambda: True) as handler:
        assert handler in log.handlers
    assert (log.level, log.handlers) == before


def test_the_log_is_left_as_it_was_found(printed: Printed) -> None:
    log = logging.getLogger(NAME)
    before = log.level, list(log.handlers)
    log.setLevel(logging.ERROR)
    try:
        with AuditLog(lambda: True):
            assert log.level == logging.INFO
        assert (log.level, log.handlers) == (logging.ERROR, before[1])
    finally:
        log.setLevel(before[0])
