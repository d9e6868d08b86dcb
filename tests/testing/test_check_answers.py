"""The conformance kit: what replies begin with is said rightly, or found (R15)."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import pytest

from busmaster.contract.exchange import Done
from busmaster.contract.timing import ReplyTiming
from busmaster.testing import Case
from busmaster.testing.protocol import check_good_reply
from tests.testing.modbus import (
    CASES,
    MODBUS,
    REPLY,
    Asking,
    ReadRegister,
    ReadsPlaces,
    WriteRegister,
    checked,
    find,
    reading_with,
)


class AnsweredByAList(Asking):
    def __init__(self, request: bytes, timing: ReplyTiming) -> None:
        super().__init__(request, timing)
        self.answers = [b"\x11\x03\x02"]  # type: ignore[assignment]  # a bug that a type checker would see


class AnsweredByAnything(Asking):
    def header(self) -> bytes:
        return b""


class AnsweredBySomethingElse(Asking):
    def header(self) -> bytes:
        return b"\x11\x04"


class AnsweredByTwo(Asking):
    def __init__(self, request: bytes, timing: ReplyTiming) -> None:
        super().__init__(request, timing)
        self.answers = (self.header(), b"\x11\x04")


class SilentAboutItsAnswers(Asking):
    def __init__(self, request: bytes, timing: ReplyTiming) -> None:
        super().__init__(request, timing)
        self.answers = ()


class NoneOverdue(Asking):
    @property
    def overdue(self) -> tuple[bytes, ...]:
        return (b"\x11\x04",)


class AnsweredWhole(Asking):
    """As if the value told one answer from another: what is overdue by register 9 could be register 7's."""

    def header(self) -> bytes:
        return REPLY if self.request[3] == 7 else checked(17, 3, 2, 0, 0)


@pytest.mark.parametrize(
    ("exchange", "finding"),
    [
        (AnsweredByAList, "answers must be a tuple of the beginnings of its replies, not \\["),
        (AnsweredByAnything, r"answers must be a tuple .* not \(b'',\)"),
        (AnsweredBySomethingElse, "the good reply 11 03 .* does not begin with one of its `answers` 11 04"),
        (AnsweredByTwo, "no step of its good reply begins with 11 04 of its `answers`"),
        (SilentAboutItsAnswers, "has a reply, but no keys"),
        (NoneOverdue, "11 03 02 02 2b 38 f8 can arrive and is not in `overdue`: 11 04"),
    ],
)
def test_what_a_reader_says_wrongly_of_its_answers_is_found(exchange: type[Asking], finding: str) -> None:
    assert re.search(finding, find(reading_with(exchange), CASES[1]))


def test_each_step_that_can_come_before_a_byte_of_the_host_must_be_overdue() -> None:
    class Acknowledged(Asking):
        overdue = (b"\x06",)

        def __init__(self) -> None:
            self.answers = (b"\x06", b"\x02\x05")

    found = list(check_good_reply(Acknowledged(), [[b"\x06", b"\x02\x05\x07"]]))
    assert found == ["before the first byte, 02 05 07 can arrive and is not in `overdue`: 06"]
    # The packet follows a byte of the host: it comes in an exchange, and is not overdue before.
    assert list(check_good_reply(Acknowledged(), [[b"\x06"], [b"\x02\x05\x07"]])) == []


def test_commands_whose_replies_could_be_exchanged_and_that_share_no_answer_are_found() -> None:
    zero = checked(17, 3, 2, 0, 0)
    other = Case(ReadRegister(9, AnsweredWhole), 17, [zero], 0)
    assert "has the `answers` 11 03 02 02 2b 38 f8, none of them a key of the other command: 11 03 02 00 00" in find(
        reading_with(AnsweredWhole), other
    )


def test_a_broadcast_that_says_by_what_it_is_answered_is_found() -> None:
    class Broadcasting(ReadsPlaces):
        answered = False

        def expired(self, started: bool, /) -> Done[Any]:
            return Done(None)

    case = Case(WriteRegister(7, 3, Broadcasting), 17, [])
    assert "has no reply, but keys: answers is (b'" in find(case)


def test_checks_that_write_or_prove_nothing_are_found() -> None:
    assert "the sync read WriteRegister" in find(profile=replace(MODBUS, sync_reads=(WriteRegister(0, 0),)))
    alike = replace(MODBUS, sync_reads=(ReadRegister(0), ReadRegister(1)))
    assert "have replies with the same beginning: 01 03 02" in find(profile=alike)
