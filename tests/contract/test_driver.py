"""The one loop over feed, expired and Expect, and the host without a clock that is made of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import pytest

from busmaster.contract.driver import MOST_STEPS, Driver, Ending, EndlessExchange
from busmaster.contract.exchange import Done, Expect, FrameError, Progress, Refused, Sizes
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.msc import codec as msc

ACK, NAK = b"\x06", b"\x15"
VALUE = bytes.fromhex("02 30 31 35 03 37")
PACKET = bytes.fromhex("02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D")
BAD = PACKET[:-1] + b"\x00"


def reading() -> Driver:
    return Driver(hcp2.Read(1).open(1, hcp2.PROFILE.timings))


def reading_packet() -> Driver:
    return Driver(msc.DataRead(2008).open(1, msc.PROFILE.timings))


def test_a_reply_ends_it_with_its_value_and_what_comes_later_is_left_over() -> None:
    driver = reading().feed(VALUE[:2], VALUE[2:] + b"\x00")
    assert driver.ending == Ending(5.0, rest=b"\x00")
    driver.feed(b"\x7f")
    assert driver.ending == Ending(5.0, rest=b"\x00\x7f")


def test_it_goes_from_step_to_step_with_bytes_that_came_in_one_chunk() -> None:
    driver = reading_packet().feed(ACK + PACKET)
    assert driver.ending == Ending(1234, send=ACK)
    assert driver.sent == []


def test_the_step_that_is_awaited_has_its_own_times_and_has_not_begun() -> None:
    driver = reading_packet()
    assert (driver.timing, driver.begun) == (msc.PROFILE.timings.read, False)
    driver.feed(ACK)
    assert (driver.timing, driver.begun) == (msc.PROFILE.timings.packet, False)
    driver.feed(PACKET[:4])
    assert driver.begun


def test_what_the_host_says_between_steps_is_told_in_order() -> None:
    driver = reading_packet().feed(ACK, BAD)
    assert driver.sent == [NAK]
    assert driver.ending is None
    driver.feed(PACKET)
    assert driver.ending == Ending(1234, send=ACK)


def test_silence_ends_it_and_says_that_nothing_came() -> None:
    ending = reading().run_out()
    assert isinstance(ending.error, FrameError)
    assert ending.silent
    cut = reading().feed(VALUE[:3]).run_out()
    assert isinstance(cut.error, FrameError)
    assert not cut.silent
    unfollowed = reading_packet().feed(ACK).run_out()
    assert (unfollowed.silent, unfollowed.send) == (True, ACK)


def test_a_cut_packet_is_asked_for_again_until_there_is_no_more_patience() -> None:
    driver = reading_packet().feed(ACK, PACKET[:9])
    ending = driver.run_out()
    assert driver.sent[0] == NAK
    assert isinstance(ending.error, FrameError)


def test_a_refusal_and_a_bug_end_it_too_and_only_one_is_a_bug() -> None:
    refused = Driver(hcp2.Write(1, (5.0,)).open(1, hcp2.PROFILE.timings)).feed(NAK).ending
    assert refused is not None
    assert isinstance(refused.error, Refused)
    assert not refused.is_bug
    broken = Driver(Odd(None)).feed(b"1").ending
    assert broken is not None
    assert broken.is_bug


def test_a_host_in_a_hurry_abandons_what_would_be_said_again() -> None:
    driver = reading_packet().feed(ACK, BAD)
    driver.abandon()
    assert driver.sent == []
    assert driver.ending is not None
    assert driver.ending.send == ACK
    assert isinstance(driver.ending.error, FrameError)


def test_noise_before_a_reply_is_left_out_for_a_profile_that_tolerates_it() -> None:
    tolerant = Driver(hcp2.Read(1).open(1, hcp2.PROFILE.timings), noise_tolerant=True)
    assert tolerant.feed(b"\x00", b"\xff" + VALUE[:1], VALUE[1:]).ending == Ending(5.0)
    strict = reading().feed(b"\x00").ending
    assert strict is not None
    assert isinstance(strict.error, FrameError)


def test_of_noise_alone_an_exchange_is_told_nothing() -> None:
    assert Driver(Odd(Done(1)), noise_tolerant=True).feed(b"\x00").ending is None


@dataclass
class Odd:
    """An exchange whose every step is the same; none is a bug of its own."""

    progress: Progress[Any] | None
    request: bytes = b"?"
    timing: Any = hcp2.PROFILE.timings.read
    sizes: Sizes = field(default_factory=lambda: Sizes(1, 1))
    later: tuple[Any, ...] = ()
    closing: int = 0
    starts: bytes = b"1"
    answers: tuple[bytes, ...] = (b"1",)
    overdue: tuple[bytes, ...] = (b"1",)
    answered: bool = True

    def feed(self, _data: bytes, /) -> Progress[Any]:
        if self.progress is None:
            raise ZeroDivisionError("a bug")
        return self.progress

    def expired(self, _started: bool, /) -> Any:
        return self.progress


@pytest.mark.parametrize("end", [lambda driver: driver.feed(b"1").ending, lambda driver: driver.run_out()])
def test_an_exchange_that_wants_one_step_after_the_other_is_found_out(end: Any) -> None:
    driver = Driver(Odd(Expect(hcp2.PROFILE.timings.read, Sizes(1, 1), NAK)))
    assert isinstance(end(driver).error, EndlessExchange)
    assert len(driver.sent) == MOST_STEPS


def test_an_ending_says_what_it_was() -> None:
    assert str(Ending(5.0)) == "the value 5.0"
    assert str(Ending(5.0, rest=b"\x00\x7f")) == "the value 5.0 and 00 7f left over"
    assert str(Ending(error=FrameError("bad checksum"))) == "FrameError('bad checksum')"


def test_endings_are_the_same_by_value_and_kind_of_error_not_by_its_words() -> None:
    assert Ending(5.0).same_as(Ending(5.0))
    for other in (Ending(6.0), Ending(5.0, send=ACK), Ending(5.0, rest=ACK), Ending(5.0, error=FrameError("one"))):
        assert not Ending(5.0).same_as(other)
    assert Ending(error=FrameError("one")).same_as(Ending(error=FrameError("other")))
    assert not Ending(error=FrameError("one")).same_as(Ending(error=Refused("one")))
    assert not Ending(error=FrameError("one"), silent=True).same_as(Ending(error=FrameError("one")))


def test_only_a_frame_error_that_says_so_is_whole() -> None:
    assert Ending(error=FrameError("bad checksum", whole=True)).is_whole
    for ending in (Ending(5.0), Ending(error=FrameError("cut")), Ending(error=Refused("no"))):
        assert not ending.is_whole
    assert [Ending(error=error).is_bug for error in (None, FrameError("one"), Refused("no"), KeyError("x"))] == [
        False,
        False,
        False,
        True,
    ]
    assert (Ending(5.0).delivered, Ending(error=Refused("no")).delivered) == (True, False)


def test_a_frame_error_says_nothing_that_nobody_told_it() -> None:
    plain = FrameError("cut short")
    assert (str(plain), plain.what, plain.whole, plain.send, plain.heard) == ("cut short", "cut short", False, b"", b"")


def test_an_empty_chunk_before_a_reply_is_harmless_and_begins_nothing() -> None:
    driver = reading().feed(b"")
    assert (driver.ending, driver.begun) == (None, False)
    assert driver.feed(VALUE).ending == Ending(5.0)


def test_a_failure_of_the_hosts_own_ends_it_and_later_bytes_do_not_count() -> None:
    driver = reading()
    driver.fail(FrameError("the port is gone", send=ACK))
    assert driver.ending is not None
    assert (driver.ending.send, driver.ending.silent) == (ACK, False)
    ended = driver.ending
    driver.feed(VALUE)
    driver.expire()
    assert driver.ending is ended
    refused = reading()
    refused.fail(Refused("no"))
    assert refused.ending is not None
    assert refused.ending.send == b""


def test_bytes_after_silence_make_the_failure_no_silence() -> None:
    driver = reading()
    driver.feed(VALUE[:2]).expire()
    assert driver.ending is not None
    assert not driver.ending.silent


@pytest.mark.parametrize("steps", [MOST_STEPS, MOST_STEPS + 1])
def test_as_many_steps_in_a_row_as_the_limit_says_are_followed(steps: int) -> None:
    driver = Driver(Counted(None, steps=steps))
    ending = driver.feed(b"1").ending
    assert ending is not None
    assert (ending.delivered, len(driver.sent)) == (steps <= MOST_STEPS, MOST_STEPS)


@dataclass
class Counted(Odd):
    """An exchange that wants some more steps, and then is done."""

    steps: int = 0

    def feed(self, _data: bytes, /) -> Progress[Any]:
        if not self.steps:
            return Done(5)
        self.steps -= 1
        return Expect(self.timing, self.sizes, NAK)
