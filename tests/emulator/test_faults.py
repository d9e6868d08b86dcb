"""What can be wrong, one fault at a time, seeded."""

from __future__ import annotations

from random import Random

import pytest

from busmaster.emulator.device import Delay
from busmaster.emulator.disturbance import Transmission, distort, misses, noise
from busmaster.emulator.faults import BEYOND, FORGED, HEARING, NAMES, SPEAKING, WITHIN, Faults
from busmaster.emulator.line import Line
from busmaster.emulator.traceable import TraceableMemory
from busmaster.errors import InvalidCommand
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.registry import make_device
from tests.emulator.lines import TAU, arrivals, ask, hexed, line_of

READ = "07 30 32 02 30 31 05 04"  # AN00129: read node 2 Comms(1)
WRITE = "07 30 32 02 30 31 31 32 33 2E 34 35 36 03 2B"
REPLY = bytes.fromhex("02 30 31 31 32 33 2E 34 35 36 03 2B")


def line_with(*settings: str, on_line: bool = False, seed: int = 1) -> Line:
    mint = EmulatedMint(2)
    mint.comms[1] = 123.456
    line = line_of(mint, seed=seed)
    line.prompt = False
    if on_line:
        line.faults = Faults.parse(settings)
    else:
        mint.faults = Faults.parse(settings)
    return line


def heard(*settings: str, request: str = READ, on_line: bool = False, seed: int = 1, seconds: float = 0.5) -> bytes:
    return bytes.fromhex(ask(line_with(*settings, on_line=on_line, seed=seed), request, seconds=seconds))


# Settings


def test_there_are_no_faults_by_default() -> None:
    faults = Faults()
    assert faults.hearing == faults.speaking == ()
    assert str(faults) == ""
    assert heard() == REPLY


def test_faults_are_read_from_text() -> None:
    faults = Faults.parse(["lost=0.1", " late = 0.5", "late_by=0.05"])
    assert (faults.lost, faults.late, faults.late_by) == (0.1, 0.5, 0.05)
    assert str(faults) == "late=0.5 late_by=0.05 lost=0.1"
    at_once = Faults.parse(["late_by=0", "away_for=0"])
    assert (at_once.late_by, at_once.away_for) == (0, 0)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("lots=0.1", "no such fault 'lots'.*did you mean 'lost'"),
        ("lost", "fault lost: '' is not a number; write for example lost=0.1"),
        ("lost=often", "'often' is not a number"),
        ("lost=1.5", "fault lost is a probability from 0 to 1, not 1.5"),
        ("lost=nan", "probability"),
        ("late_by=-1", "fault late_by is a number of seconds"),
        ("late_by=inf", "fault late_by is a number of seconds, 0 or more, not inf"),
        ("away_for=inf", "fault away_for is a number of seconds, 0 or more, not inf"),
        ("hearing=1", "no such fault"),
    ],
)
def test_a_setting_that_is_none_is_refused_in_words(setting: str, message: str) -> None:
    with pytest.raises(InvalidCommand, match=message):
        Faults.parse([setting])


def test_they_can_be_changed_while_it_runs() -> None:
    line = line_with()
    faults = line.device(2).faults
    faults.lost = 1.0
    assert ask(line, READ) == ""
    faults.lost = 0.0
    assert ask(line, READ, 1.0) == hexed(REPLY)


def test_every_fault_is_inside_or_outside_the_masters_assumption() -> None:
    assert WITHIN | BEYOND | {"late_by", "away_for"} == set(NAMES)
    assert set(HEARING) | set(SPEAKING) == WITHIN | BEYOND
    assert Faults.parse(["lost=0.1", "flip=0.1"]).beyond == frozenset()
    assert Faults.parse(["lost=0.1", "forged=0.1"]).beyond == {"forged"}
    assert {name for name in (*HEARING, *SPEAKING) if Faults.parse([f"{name}=0.1"]).beyond == {name}} == BEYOND
    assert Faults.parse(f"{name}=0.1" for name in (*HEARING, *SPEAKING)).beyond == BEYOND


def test_the_same_seed_does_the_same() -> None:
    every = [f"{name}=0.3" for name in SPEAKING]
    for seed in range(5):
        assert heard(*every, seed=seed) == heard(*every, seed=seed)
    assert len({heard(*every, seed=seed) for seed in range(20)}) > 5


def test_a_rate_is_a_share_of_the_frames() -> None:
    line = line_with("lost=0.2")
    answered = sum(bool(ask(line, READ, now, 0.1)) for now in range(300))
    assert 210 < answered < 270


# What each does


@pytest.mark.parametrize("fault", ["lost", "deaf", "dead"])
def test_silence(fault: str) -> None:
    assert heard(f"{fault}=1") == b""


def test_a_request_that_is_not_heard_changes_nothing_but_one_whose_answer_is_lost_does() -> None:
    for fault, stored in (("deaf", 123.456), ("lost", 7.0)):
        line = line_with(f"{fault}=1")
        assert ask(line, "07 30 32 02 30 31 37 03 35") == ""  # Comms(1) = 7
        mint = line.device(2)
        assert isinstance(mint, EmulatedMint)
        assert mint.comms[1] == stored


def test_late() -> None:
    line = line_with("late=1", "late_by=0.1")
    line.send(bytes.fromhex(READ), 0.0)
    [(when, data)] = arrivals(line, 1.0)
    assert data == hexed(REPLY)
    usual = 8 * TAU + 0.002 + len(REPLY) * TAU
    assert usual < when <= usual + 0.1
    line.device(2).faults.late = 0.0
    line.send(bytes.fromhex(READ), 1.0)
    assert arrivals(line, 2.0)[0][0] == pytest.approx(1.0 + usual)


def test_a_bit_flipped() -> None:
    got = heard("flip=1")
    assert sum((a ^ b).bit_count() for a, b in zip(got, REPLY, strict=True)) == 1


def test_two_bits_flipped_that_an_exclusive_or_cannot_see() -> None:
    for seed in range(60):  # for some of these the second byte drawn would be the first one again
        got = heard("unseen=1", seed=seed)
        changed = [a ^ b for a, b in zip(got, REPLY, strict=True) if a != b]
        assert len(changed) == 2
        assert changed[0] == changed[1]


def test_truncated() -> None:
    for seed in range(10):
        got = heard("truncated=1", seed=seed)
        assert REPLY.startswith(got)
        assert got != REPLY


def test_doubled() -> None:
    assert heard("doubled=1") == REPLY + REPLY


def test_repeated_after_a_while() -> None:
    line = line_with("repeated=1")
    line.send(bytes.fromhex(READ), 0.0)
    (first, data), (second, again) = arrivals(line, 1.0)
    assert data == again == hexed(REPLY)
    assert second - first > 0.005


def test_a_wrong_element_with_a_right_checksum() -> None:
    got = heard("wrong=1")
    assert got[1:3] != REPLY[1:3]
    assert got[3:-2] == REPLY[3:-2]
    assert len(got) == len(REPLY)
    assert heard("wrong=1", request=WRITE) == b"\x06"  # an ACK names nobody


@pytest.mark.parametrize(
    ("protocol", "modulus", "request_", "value"),
    [
        ("hcp", 10**12, "04 31 31 02 30 31 05", slice(3, -2)),
        ("hcp2", 10**12, "07 30 31 02 30 31 05 07", slice(3, -2)),
        ("mentor", 10**4, "04 30 30 31 31 30 31 31 37 05", slice(5, -2)),
        ("msc", 2**31, "02 01 00 08 00 00 44 52 45 41 44 2C 07 D8 02 74", slice(-6, -2)),
        ("dc104", 2**16, "02 AA 01 AB", slice(2, -1)),
    ],
)
def test_a_reply_for_somebody_else_carries_somebody_elses_value(
    protocol: str, modulus: int, request_: str, value: slice
) -> None:
    """Else a reader that does not look at the echo would not be caught."""
    address = 0 if protocol == "dc104" else 1
    right, wrong = (make_device(protocol, address, traceable=TraceableMemory(address, modulus)) for _ in range(2))
    wrong.faults.wrong = 1.0
    answers = [bytes.fromhex(ask(line_of(device), request_)) for device in (right, wrong)]
    assert answers[0][value] != answers[1][value]


def test_a_duplicate_address_collides_or_answers_too() -> None:
    heard_twice = collided = 0
    for seed in range(20):
        line = line_with("duplicate=1", seed=seed)
        heard_twice += ask(line, READ) == f"{hexed(REPLY)} {hexed(REPLY)}"
        collided += line.collisions
    assert heard_twice
    assert collided
    assert heard_twice + collided == 20


def test_noise_before_and_behind() -> None:
    before, behind = heard("leading=1"), heard("trailing=1")
    assert before.endswith(REPLY)
    assert 1 <= len(before) - len(REPLY) <= 3
    assert behind.startswith(REPLY)
    assert 1 <= len(behind) - len(REPLY) <= 3


def test_noise_is_never_a_reply_by_itself() -> None:
    chance = Random(1)
    for _ in range(500):
        burst = noise(chance, 8)
        assert 1 <= len(burst) <= 8
        assert not set(burst) & set(FORGED)
        assert not {byte & 0x7F for byte in burst} & {*FORGED, 0x08}, "nor to a Mentor II, whose characters have 7 bits"


def test_a_forged_reply() -> None:
    got = heard("forged=1")
    assert got[:1] in (b"\x06", b"\x15", b"\x04")
    assert got[1:] == REPLY


def test_babble() -> None:
    got = heard("babble=1", seed=3)
    assert len(got) > len(REPLY)


def test_split_chunks() -> None:
    line = line_with("split=1")
    line.send(bytes.fromhex(READ), 0.0)
    chunks = arrivals(line, 1.0)
    assert len(chunks) > 2
    assert bytes.fromhex("".join(data for _, data in chunks)) == REPLY


def test_a_storm_of_refusals_changes_nothing() -> None:
    line = line_with("nak=1")
    assert ask(line, "07 30 32 02 30 31 37 03 35") == "15"
    mint = line.device(2)
    assert isinstance(mint, EmulatedMint)
    assert mint.comms[1] == 123.456


def test_a_flapping_device_comes_back_as_it_was() -> None:
    line = line_with("flapping=1", "away_for=2")
    assert ask(line, READ) == ""
    line.device(2).faults.flapping = 0.0
    assert ask(line, READ, 5.0) == hexed(REPLY)


def test_a_restarted_device_comes_back_without_its_ram() -> None:
    line = line_with("restart=1", "away_for=2")
    assert ask(line, READ) == ""
    line.device(2).faults.restart = 0.0
    assert ask(line, READ, 5.0) == "02 30 31 30 03 32"  # Comms(1) = 0


def test_a_device_that_restarts_does_not_say_what_it_was_about_to_say() -> None:
    """Neither after what it says next, which would be out of order, nor in place of it."""
    line = line_with()
    mint = line.device(2)
    mint.delay = Delay(0.1)
    line.send(bytes.fromhex(READ), 0.0)
    line.receive(0.05)
    mint.faults.restart, mint.faults.away_for = 1.0, 0.001
    line.send(bytes.fromhex(READ), 0.06)
    line.receive(0.09)
    mint.faults.restart, mint.delay = 0.0, Delay(0.001)
    line.send(bytes.fromhex(READ), 0.09)
    assert [data for _, data in arrivals(line, 1.0)] == ["02 30 31 30 03 32"]  # Comms(1) = 0


def test_what_comes_while_it_is_busy_is_queued_or_dropped() -> None:
    """A device that takes 10 ms is asked again after 5."""
    for settings, replies in (((), 2), (("drop=1",), 1)):
        line = line_with(*settings)
        line.device(2).delay = Delay(0.01)
        line.send(bytes.fromhex(READ), 0.0)
        line.send(bytes.fromhex(READ), 0.005)
        assert [data for _, data in arrivals(line, 1.0)] == [hexed(REPLY)] * replies


def test_faults_of_the_line_strike_requests_too() -> None:
    line = line_with("lost=1", on_line=True)
    assert ask(line, WRITE.replace("31 32 33", "39 32 33")) == ""
    mint = line.device(2)
    assert isinstance(mint, EmulatedMint)
    assert mint.comms[1] == 123.456
    answers = {heard("flip=1", on_line=True, seed=seed) for seed in range(20)}
    assert b"" in answers  # the node's address was hit
    assert any(len(answer) == 1 and answer != b"\x15" for answer in answers)  # NAK of a hit checksum, itself hit


def test_a_doubled_request_is_answered_twice_or_collides() -> None:
    line = line_with("doubled=1", on_line=True)
    got = bytes.fromhex(ask(line, READ))
    assert got.count(REPLY) >= 2


class Least:
    """A source of chance that always returns the lower end."""

    def random(self) -> float:
        return 0.0

    def uniform(self, a: float, b: float) -> float:
        return a

    def randrange(self, start: int, stop: int) -> int:
        return start

    def getrandbits(self, k: int) -> int:
        return 0


class Most(Least):
    """Likewise the upper end."""

    def uniform(self, a: float, b: float) -> float:
        return b

    def randrange(self, start: int, stop: int) -> int:
        return stop - 1

    def getrandbits(self, k: int) -> int:
        return (1 << k) - 1


STX_NOISE = b"\x02\xff\xff"


@pytest.mark.parametrize(
    ("fault", "least", "most"),
    [
        ("lost", [], []),
        ("truncated", [], [(1.0, b"ab", 0)]),
        ("flip", [(1.0, b"`bc", 0)], [(1.0, b"ab\xe3", 0)]),
        ("unseen", [(1.0, b"`cc", 0)], [(1.0, b"a\xe2\xe3", 0)]),
        ("doubled", [(1.0, b"abcabc", 0)], [(1.0, b"abcabc", 0)]),
        ("leading", [(1.0, b"\0abc", 0)], [(1.0, STX_NOISE + b"abc", 0)]),
        ("trailing", [(1.0, b"abc\0", 0)], [(1.0, b"abc" + STX_NOISE, 0)]),
        ("repeated", [(1.0, b"abc", 0), (1.035, b"abc", 0)], [(1.0, b"abc", 0), (1.33, b"abc", 0)]),
        ("duplicate", [(1.0, b"abc", 0), (1.0, b"abc", 0)], [(1.0, b"abc", 0), (1.1, b"abc", 0)]),
        ("forged", [(1.0, b"\x06abc", 0)], [(1.0, b"\x04abc", 0)]),
        ("babble", [(1.0, b"abc", 0), (1.0, b"\0", 0)], [(1.0, b"abc", 0), (1.1, b"\x02" + b"\xff" * 59, 0)]),
        ("split", [(1.0, b"abc", 1)], [(1.0, b"abc", 4)]),
        ("wrong", [(1.0, b"abc", 0)], [(1.0, b"abc", 0)]),
    ],
)
def test_what_becomes_of_a_frame_stays_within_the_bounds_of_the_fault(
    fault: str, least: list[Transmission], most: list[Transmission]
) -> None:
    device = EmulatedMint(2, delay=Delay(0.05))
    for chance, wanted in ((Least(), least), (Most(), most)):
        found = distort(Faults.parse([f"{fault}=1"]), (1.0, b"abc", 0), device, 0.01, chance)
        assert [(data, chunk) for _, data, chunk in found] == [(data, chunk) for _, data, chunk in wanted]
        assert [start for start, _, _ in found] == pytest.approx([start for start, _, _ in wanted])


def test_a_duplicate_request_of_the_host_follows_within_4_ms() -> None:
    found = distort(Faults.parse(["duplicate=1"]), (1.0, b"abc", 0), None, 0.01, Most())
    assert found[1][0] == pytest.approx(1.004)


def test_a_lost_frame_has_no_other_fault_and_others_add_up() -> None:
    faults = Faults.parse(["lost=1", "babble=1", "doubled=1"])
    assert distort(faults, (1.0, b"abc", 0), None, 0.01, Most()) == []
    faults.lost, faults.babble, faults.split = 0.0, 0.0, 1.0
    assert distort(faults, (1.0, b"abc", 0), None, 0.01, Most()) == [(1.0, b"abcabc", 4)]


def test_a_frame_that_is_truncated_to_nothing_may_be_replaced_by_noise() -> None:
    found = distort(Faults.parse(["truncated=1", "babble=1"]), (1.0, b"abc", 0), None, 0.01, Least())
    assert found == [(1.0, b"\0", 0)]


class Same(Least):
    """A source of chance that draws one number again and again."""

    def __init__(self, number: int) -> None:
        self.number = number

    def randrange(self, start: int, stop: int) -> int:
        assert start <= self.number < stop
        return self.number


@pytest.mark.parametrize(
    ("protocol", "address", "request_", "number"),
    [
        ("hcp2", 2, READ, 1),
        ("hcp", 2, "04 32 32 02 30 31 05", 1),
        ("mentor", 12, "04 31 31 32 32 30 31 31 37 05", 117),
        ("ct-ansi", 12, "04 31 31 32 32 30 31 31 37 05", 117),
        ("dc104", 1, "02 AA 01 AB", 1),
        ("msc", 1, "02 01 00 08 00 00 44 52 45 41 44 2C 07 D8 02 74", 1),
        ("modbus", 2, "02 03 00 00 00 01 84 39", 2),
    ],
)
def test_a_disguised_reply_is_never_that_to_the_request(
    protocol: str, address: int, request_: str, number: int
) -> None:
    device = make_device(protocol, address)
    reply = bytes.fromhex(ask(line_of(device), request_)).removeprefix(b"\x06")
    for drawn in (max(1, number - 1), number):
        assert device.disguise(reply, Same(drawn)) != reply


def received(fault: str, *, request: bool = True, free_at: float = 0.0) -> tuple[bool, EmulatedMint]:
    """Return whether a device with this fault misses bytes on the line from 1 s to 2 s, and the device."""
    device = EmulatedMint(2)
    device.free_at = free_at
    device.faults = Faults.parse([f"{fault}=1", "late_by=0.5", "away_for=3"])
    return misses(device, 1.0, 2.0, request, Most()), device


@pytest.mark.parametrize(
    ("fault", "request_", "free_at", "missed"),
    [
        ("dead", True, 0.0, True),
        ("dead", False, 0.0, True),
        ("deaf", True, 0.0, True),
        ("deaf", False, 0.0, False),
        ("drop", True, 1.5, True),
        ("drop", False, 1.5, True),
        ("drop", True, 1.0, False),
        ("flapping", True, 0.0, True),
        ("flapping", False, 0.0, False),
        ("restart", True, 0.0, True),
        ("restart", False, 0.0, False),
        ("nak", True, 0.0, True),
        ("nak", False, 0.0, False),
        ("late", True, 0.0, False),
    ],
)
def test_which_bytes_a_faulty_device_misses(fault: str, request_: bool, free_at: float, missed: bool) -> None:
    found, device = received(fault, request=request_, free_at=free_at)
    assert found is missed
    assert device.restarted is (fault == "restart" and request_)
    assert device.away_until == (5.0 if fault in ("flapping", "restart") and request_ else 0.0)
    assert [data for _, data in device.outbox] == ([device.refusal] if fault == "nak" and request_ else [])
    assert device.lag == (0.5 if fault == "late" and request_ else 0.0)


def test_a_device_that_is_away_misses_everything_until_it_is_back() -> None:
    device = EmulatedMint(2)
    device.away_until = 1.0
    device.lag = 0.5
    assert misses(device, 0.9, 1.1, False, Most())
    assert not misses(device, 1.0, 1.1, True, Most())
    assert device.lag == 0.0
