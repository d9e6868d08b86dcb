"""The conformance kit: a sixth protocol (Modbus RTU) passes it, and each planted bug is found."""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import count
from typing import Any, ClassVar

import pytest

from busmaster.contract.exchange import Command, Done, Expect, FrameError, LaterStep, Need, Sizes, no_reply
from busmaster.contract.profile import Profile
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.errors import Refused
from busmaster.testing import Foreign, NotConformant, RoundTrip, Unseen, answers_of, check_protocol
from tests.testing.modbus import (
    CASES,
    MODBUS,
    READING,
    REPLY,
    Asking,
    ReadRegister,
    ReadsPlaces,
    Registers,
    WriteRegister,
    checked,
    find,
    named,
    reading_with,
)


def round_trip(values: Sequence[int] = (0, 1, 0x0302, 0xFFFF), **options: Any) -> RoundTrip:
    return RoundTrip(17, lambda value: WriteRegister(7, value), ReadRegister(7), values, **options)


def test_a_sixth_protocol_passes() -> None:
    tally = check_protocol(
        MODBUS,
        CASES,
        names=named,
        foreign=[Foreign(ReadRegister(7), 17, checked(17, 4, 2, 2, 0x2B), "the reply to another function")],
        invalid=[lambda: ReadRegister(70000), lambda: WriteRegister(1, -1)],
        round_trips=[round_trip()],
        device=answers_of(Registers(17)),
    )
    assert tally["round trips"] == 4
    assert tally["flips"] == 8 * sum(len(case.steps[0]) for case in CASES)
    assert min(tally[kind] for kind in ("cases", "splits", "truncations", "foreign", "garbage")) >= len(CASES)


def test_a_kit_without_cases_has_shown_nothing() -> None:
    with pytest.raises(NotConformant, match="no case"):
        check_protocol(MODBUS, [])


# planted bugs in a reader


class CheckingNoUnit(Asking):
    def echoed(self, frame: bytes) -> bool:
        return frame[1:3] == b"\x03\x02"


class CheckingNoCrc(Asking):
    def sound(self, frame: bytes) -> bool:
        return True


class CallingAForeignFrameWhole(Asking):
    def feed(self, data: bytes, /) -> Need | Expect | Done[Any]:
        try:
            return super().feed(data)
        except FrameError as error:
            raise FrameError(error.what, whole=True) from None


class ReadingOnlyWholeChunks(Asking):
    def feed(self, data: bytes, /) -> Need | Expect | Done[Any]:
        self.buffer = b""
        return super().feed(data)


class TakingTheRest(Asking):
    def feed(self, data: bytes, /) -> Need | Expect | Done[Any]:
        progress = super().feed(data)
        return Done(progress.value) if isinstance(progress, Done) else progress


class ContentWithLess(Asking):
    def expired(self, started: bool, /) -> Done[Any]:
        if started:
            return Done(int.from_bytes(self.buffer[3:5], "big"))
        raise no_reply()


class ContentWithSilence(Asking):
    def expired(self, started: bool, /) -> Done[Any]:
        return Done(0)


class Crashing(Asking):
    def size(self) -> int:
        return {2: 7}[self.buffer[2]]


class AskingForEver(Asking):
    def expired(self, started: bool, /) -> Expect:
        return Expect(self.timing, self.sizes, b"again")


class TurningForEver(Asking):
    def feed(self, data: bytes, /) -> Expect:
        return Expect(self.timing, self.sizes)


class SearchingForItsUnit(Asking):
    """And so finding a reply in the middle of noise."""

    def feed(self, data: bytes, /) -> Need | Expect | Done[Any]:
        start = (self.buffer + data).find(17)
        self.buffer, data = b"", (self.buffer + data)[max(start, 0) :]
        return super().feed(data)


class CheckingOneChunkAlone(Asking):
    """A reply in several chunks is accepted whatever its CRC."""

    def feed(self, data: bytes, /) -> Need | Expect | Done[Any]:
        self.chunks = getattr(self, "chunks", 0) + 1
        return super().feed(data)

    def sound(self, frame: bytes) -> bool:
        return self.chunks > 1 or super().sound(frame)


class RefusedByAForeignByte(Asking):
    """A NAK, which is not in `starts`, ends it like an exception."""

    def feed(self, data: bytes, /) -> Need | Expect | Done[Any]:
        if not self.buffer and data == b"\x15":
            raise Refused
        return super().feed(data)


class CrashingAtAnEmptyChunk(Asking):
    def feed(self, data: bytes, /) -> Need | Expect | Done[Any]:
        self.first = data[0]
        return super().feed(data)


class BeginningElsewhere(Asking):
    def __init__(self, request: bytes, timing: ReplyTiming) -> None:
        super().__init__(request, timing)
        self.starts = b"\x99"


class SmallerThanItSays(Asking):
    sizes = Sizes(3, 5)


class SizedBackwards(Asking):
    sizes = Sizes(9, 8)


class SizedBackwardsInALaterStep(Asking):
    later = (LaterStep(MODBUS.timings.packet, Sizes(6, 5)),)


class ClosingWithMoreThanItSays(Asking):
    def feed(self, data: bytes, /) -> Need | Expect | Done[Any]:
        progress = super().feed(data)
        return Done(progress.value, send=b"\x06", rest=progress.rest) if isinstance(progress, Done) else progress


class WithALegTooMany(Asking):
    later = (LaterStep(MODBUS.timings.packet, Sizes(1, 1)),)


class Unanswered(Asking):
    answered = False


class WithATimingOfItsOwn(Asking):
    def __init__(self, request: bytes, timing: ReplyTiming) -> None:
        super().__init__(request, ReplyTiming(0.1, 0.2, 0.3, 0.4))


class SendingNothing(Asking):
    def __init__(self, request: bytes, timing: ReplyTiming) -> None:
        super().__init__(request, timing)
        self.request = b""


class NumberingItsRequests(Asking):
    numbers = count()

    def __init__(self, request: bytes, timing: ReplyTiming) -> None:
        super().__init__(request + bytes((next(self.numbers) % 256,)), timing)


@pytest.mark.parametrize(
    ("exchange", "finding"),
    [
        (CheckingNoUnit, "the reply to read register 7 of 18, .* gives the value 555"),
        (CheckingNoCrc, "11 03 02 03 2b 38 f8 in place of 11 03 02 02 2b 38 f8 gives the value 811"),
        (CallingAForeignFrameWhole, r"the reply to read register 7 of 18, .* gives FrameError\('wrong echo'\)"),
        (ReadingOnlyWholeChunks, r"gives the value 555, and .* as 11 \|"),
        (TakingTheRest, "bytes after the reply in the same chunk are not returned"),
        (ContentWithLess, "3 of the 7 bytes .* end when time runs out with the value 0"),
        (ContentWithSilence, "with no reply at all it ends with the value 0"),
        (Crashing, "KeyError"),
        (AskingForEver, "Endless"),
        (TurningForEver, "Endless"),
        (SearchingForItsUnit, "00, which is not in starts, and then the reply gives the value 555"),
        (CheckingOneChunkAlone, "11 03 02 03 2b 38 f8 in place of 11 03 02 02 2b 38 f8 gives the value 811"),
        (RefusedByAForeignByte, r"15, which is not in starts, and then the reply gives Refused"),
        (CrashingAtAnEmptyChunk, "IndexError"),
        (BeginningElsewhere, "its reply begins with 11, which is not in starts"),
        (SmallerThanItSays, "a step of 7 bytes is longer than the 5 announced"),
        (SizedBackwards, "typically 9 and at most 8 bytes"),
        (SizedBackwardsInALaterStep, "typically 6 and at most 5 bytes"),
        (ClosingWithMoreThanItSays, "closes with 1 bytes, not with the 0 announced"),
        (WithALegTooMany, "1 steps in place of the 2 announced"),
        (Unanswered, "a read without a reply"),
        (WithATimingOfItsOwn, "does not use the read or write timing"),
        (NumberingItsRequests, "sends .*, and then"),
        (SendingNothing, r"ReadRegister\(.*\) sends '', and then ''"),
    ],
)
def test_a_bug_in_a_reader_is_found(exchange: type[Asking], finding: str) -> None:
    assert re.search(finding, find(reading_with(exchange), CASES[1]))


def test_a_refusal_of_the_wrong_kind_and_a_wrong_value_are_found() -> None:
    class Special(Refused):
        """What a device says that knows more."""

    wrong = [replace(CASES[-1], raises=Special), replace(READING, value=554), replace(READING, steps=[REPLY[:-1]])]
    findings = find(*wrong, replace(READING, request=b"\x11"))
    assert re.search(r"gives Refused\(.exception 2.*\) in place of Special", findings)
    assert "gives the value 555 in place of 554" in findings
    assert "does not end it" in findings
    assert "in place of 11\n" in findings + "\n"


def test_replies_that_cannot_be_told_apart_are_found_unless_the_tester_says_so() -> None:
    assert "the reply to read register 9 of 17" in find(
        READING, replace(READING, command=ReadRegister(9)), names=lambda command, address: (address, command)
    )


def test_a_foreign_reply_that_is_accepted_is_found_with_its_reason() -> None:
    stale = Foreign(ReadRegister(7), 17, REPLY, "the late reply to register 8")
    assert "the late reply to register 8, 11 03" in find(foreign=[stale])


def test_a_flip_that_is_listed_is_let_pass_and_one_that_is_listed_in_vain_is_not() -> None:
    flips = [REPLY[:3] + bytes((REPLY[3] ^ 1 << bit,)) + REPLY[4:] for bit in range(8)]
    heedless = type(
        "Heedless", (Asking,), {"sound": lambda self, frame: frame[:3] + frame[4:] == REPLY[:3] + REPLY[4:]}
    )
    listed = [Unseen(REPLY, heard, "the first data byte is not checked") for heard in flips]
    check_protocol(MODBUS, [reading_with(heedless)], unseen=listed, names=named)
    assert "remove it from `unseen`" in find(READING, unseen=listed[:1])


# planted bugs in a command


class Loose:
    """A command that is no value: mutable, without a text, not hashable, and unequal to its copy."""

    writes = False
    idempotent = False

    def __init__(self) -> None:
        self.register = 7

    def open(self, address: int, timings: Timings, /) -> Asking:
        return ReadRegister(self.register).open(address, timings)


class Unhashable(Loose):
    def __eq__(self, other: object) -> bool:
        return type(self) is type(other)

    __hash__ = None  # type: ignore[assignment]  # how Python marks what has no hash


class HashedByIdentity(Unhashable):
    writes = 0  # type: ignore[assignment]  # a bug that a type checker would see

    def __hash__(self) -> int:  # type: ignore[override]  # the base has none
        return id(self)


class Wordless(Loose):
    idempotent = 1  # type: ignore[assignment]  # a bug that a type checker would see

    def __str__(self) -> str:
        return ""


class Reopened(Loose):
    def open(self, address: int, timings: Timings, /) -> Asking:
        return ONE_EXCHANGE


ONE_EXCHANGE = ReadRegister(7).open(17, MODBUS.timings)


@pytest.mark.parametrize(
    ("command", "finding"),
    [
        (Loose(), "has no text"),
        (Loose(), "does not equal its copy"),
        (Loose(), r"Loose\.something_new can be changed"),
        (Loose(), "is a read and not idempotent"),
        (Unhashable(), "is not hashable"),
        (HashedByIdentity(), "has another hash than its copy"),
        (HashedByIdentity(), "writes and idempotent are True or False"),
        (Wordless(), "has no text"),
        (Wordless(), "writes and idempotent are True or False"),
        (Reopened(), "opens the same exchange twice"),
    ],
)
def test_a_bug_in_a_command_is_found(command: Command[Any], finding: str) -> None:
    assert re.search(finding, find(replace(READING, command=command), names=lambda command, address: None))


@dataclass(slots=True, unsafe_hash=True)
class OfRegister:
    register: int


class Changeable(OfRegister):
    """A command like a value, but its register can be changed."""

    __slots__ = ()
    writes: ClassVar[bool] = False
    idempotent: ClassVar[bool] = True

    def __str__(self) -> str:
        return f"read register {self.register}"

    def open(self, address: int, timings: Timings, /) -> Asking:
        return ReadRegister(self.register).open(address, timings)


def test_a_command_of_which_a_field_can_be_changed_is_found_and_stays_as_it_is() -> None:
    case = replace(READING, command=Changeable(7))
    with pytest.raises(NotConformant) as found:
        check_protocol(MODBUS, [case])
    assert found.value.findings == ("Changeable.register can be changed: make it a frozen dataclass with slots",)
    assert case.command == Changeable(7)


def refuse_all() -> None:
    raise ValueError("not an InvalidCommand")


def test_bad_arguments_that_are_not_refused_are_found() -> None:
    builders: list[Callable[[], object]] = [lambda: ReadRegister(7), refuse_all]
    findings = find(invalid=builders)
    assert "invalid[0] builds ReadRegister(register=7" in findings
    assert "invalid[1] raises ValueError('not an InvalidCommand')" in findings


def test_bugs_in_a_profile_are_found() -> None:
    assert "the probe WriteRegister" in find(profile=replace(MODBUS, probe=WriteRegister(0, 0)))
    deaf = type("Deaf", (Loose,), {"open": lambda self, address, timings: ReadRegister(7).open(1, timings)})
    assert "addresses 1 and 2 have the same request 01 03" in find(profile=replace(MODBUS, probe=deaf()))


class TakingAnyAddress(Profile):
    taken: ClassVar[int]

    def check_address(self, address: int) -> None:
        if address != self.taken:
            super().check_address(address)


@pytest.mark.parametrize("wrong", [0, 248])
def test_an_address_before_the_first_or_after_the_last_that_is_accepted_is_found(wrong: int) -> None:
    kind = type("Taking", (TakingAnyAddress,), {"taken": wrong})
    taking = kind(**{one.name: getattr(MODBUS, one.name) for one in fields(MODBUS)})
    assert re.search(r"invalid\[\d\] builds None", find(profile=taking))
    check_protocol(replace(taking, broadcast=wrong), CASES, names=named)


class DeafListener:
    def feed(self, data: bytes, /) -> Done[None]:
        raise KeyError(data[:1])

    def expired(self) -> Any:
        return None


class EndlessListener(DeafListener):
    def feed(self, data: bytes, /) -> Done[None]:
        return Done(None)


class BreakingListener(DeafListener):
    """It rejects its first chunk, and has a bug in what it does with the next one."""

    def __init__(self) -> None:
        self._rejects = True

    def feed(self, data: bytes, /) -> Done[None]:
        if self._rejects:
            self._rejects = False
            raise FrameError("no frame begins so")
        return super().feed(data)

    def expired(self) -> Done[None]:
        return Done(None)


def test_bugs_in_a_listener_are_found() -> None:
    findings = find(READING, profile=replace(MODBUS, listen=DeafListener))
    assert "the listener raises KeyError" in findings
    assert "the listener has no end" in find(READING, profile=replace(MODBUS, listen=EndlessListener))


def test_a_listener_that_fails_at_the_bytes_after_a_bad_frame_is_found() -> None:
    assert "the listener raises KeyError" in find(READING, profile=replace(MODBUS, listen=BreakingListener))


class Noting(EndlessListener):
    """Notes what it hears."""

    heard: ClassVar[list[bytes]] = []

    def feed(self, data: bytes, /) -> Done[None]:
        self.heard.append(data)
        return Done(None)

    def expired(self) -> Done[None]:
        return Done(None)


def test_the_garbage_is_as_much_as_is_wanted_and_of_the_seed_that_is_wanted() -> None:
    def garbage(seed: int) -> list[bytes]:
        Noting.heard.clear()
        tally = check_protocol(replace(MODBUS, listen=Noting), [READING], garbage=7, seed=seed)
        assert tally["garbage"] == 7
        return Noting.heard.copy()

    assert garbage(1) == garbage(1) != garbage(2)


# round trips


def test_a_value_that_is_not_read_back_is_found() -> None:
    class Rounding(Registers):
        def hear(self, data: bytes, start: float) -> None:
            super().hear(data, start)
            if self.registers:
                self.registers[b"\0\7"] = self.registers[b"\0\7"][:1] + b"\0"

    answers = answers_of(Rounding(17))
    assert "write register 7 = 258, then read register 7 gives the value 256" in find(
        round_trips=[round_trip([258])], device=answers
    )
    check_protocol(
        MODBUS,
        CASES,
        names=named,
        round_trips=[round_trip([258], read_back=lambda value: value & 0xFF00)],
        device=answers,
    )


class _Placed(ReadRegister):
    @property
    def places(self) -> tuple[Hashable, ...]:
        return (self.register,)

    def shown(self, values: Mapping[Hashable, Any]) -> Any:
        return values[self.register]


class _Changing(WriteRegister):
    shift: ClassVar[int] = 0
    factor: ClassVar[int] = 1

    def changes(self, profile: Profile) -> Mapping[Hashable, Any]:
        return {self.register + self.shift: self.value * self.factor}


class _Elsewhere(_Changing):
    shift = 1


class _OtherValue(_Changing):
    factor = 10


@pytest.mark.parametrize(
    ("write", "finding"),
    [
        (_Elsewhere, "does not declare a change of [7], which read register 7 reads"),
        (_OtherValue, "declares 30 as the new value, but read register 7 returns 3"),
    ],
)
def test_a_write_that_says_wrongly_what_it_changes_is_found(write: type[_Changing], finding: str) -> None:
    def trips(kind: type[_Changing]) -> list[RoundTrip]:
        return [RoundTrip(17, lambda value: kind(7, value), _Placed(7), [3])]

    check_protocol(MODBUS, CASES, names=named, round_trips=trips(_Changing), device=answers_of(Registers(17)))
    assert finding in find(round_trips=trips(write), device=answers_of(Registers(17)))


class WritingThreeTimes(ReadsPlaces):
    """A write in three steps: the host sends twice more."""

    again = 2

    def feed(self, data: bytes, /) -> Need | Expect | Done[Any]:
        step = super().feed(data)
        if isinstance(step, Done) and self.again:
            self.again -= 1
            self.buffer = b""
            return Expect(self.timing, self.sizes, self.request)
        return step


def test_the_device_hears_each_further_step_of_the_host() -> None:
    heard: list[bytes] = []
    answers = answers_of(Registers(17))

    def device(sent: bytes) -> bytes:
        heard.append(sent)
        return answers(sent)

    trip = RoundTrip(17, lambda value: WriteRegister(7, value, WritingThreeTimes), ReadRegister(7), [3])
    check_protocol(MODBUS, CASES, names=named, round_trips=[trip], device=device)
    write, read = checked(17, 6, 0, 7, 0, 3), checked(17, 3, 0, 7, 0, 1)
    assert heard == [write, write, write, read]


class Closing(Asking):
    """A read that the host closes with an ACK."""

    closing = 1

    def feed(self, data: bytes, /) -> Need | Expect | Done[Any]:
        progress = super().feed(data)
        return Done(progress.value, send=b"\x06", rest=progress.rest) if isinstance(progress, Done) else progress


def test_the_device_hears_what_closes_an_exchange() -> None:
    heard: list[bytes] = []
    answers = answers_of(Registers(17))

    def device(sent: bytes) -> bytes:
        heard.append(sent)
        return answers(sent) if sent != b"\x06" else b""

    trip = RoundTrip(17, lambda value: WriteRegister(7, value), ReadRegister(7, Closing), [3, 4])
    check_protocol(MODBUS, [READING], round_trips=[trip], device=device)
    read = checked(17, 3, 0, 7, 0, 1)
    assert heard == [checked(17, 6, 0, 7, 0, 3), read, b"\x06", checked(17, 6, 0, 7, 0, 4), read, b"\x06"]


def test_a_device_that_does_not_answer_is_found() -> None:
    assert "gives FrameError('no reply')" in find(round_trips=[round_trip()], device=answers_of(Registers(18)))


def test_round_trips_need_a_device() -> None:
    assert "need a device" in find(round_trips=[round_trip()])
