"""The wire's physics: byte times, half-duplex, collisions, echo, turnaround, a cut."""

from __future__ import annotations

import itertools
from random import Random
from typing import Any, cast

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from busmaster.contract.profile import LineSettings
from busmaster.emulator.collision import Collision
from busmaster.emulator.device import Delay, Device, held
from busmaster.emulator.faults import HEARING, SPEAKING, Faults
from busmaster.emulator.line import PIECE, Echo, Line
from busmaster.errors import InvalidCommand
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.registry import make_device
from tests.emulator.lines import SETTINGS, TAU, arrivals, ask, hexed, line_of

READ_2 = bytes.fromhex("07 30 32 02 30 31 05 04")  # AN00129: read node 2 Comms(1)
READ_3 = bytes.fromhex("07 30 33 02 30 31 05 05")
REPLY = "02 30 31 30 03 32"  # Comms(1) = 0
WRITE_2 = bytes.fromhex("07 30 32 02 30 31 31 32 33 2E 34 35 36 03 2B")


class Ear(Device):
    """Hears everything and notes when each byte ended."""

    def __init__(self) -> None:
        super().__init__(0)
        self.attentive = True
        self.heard: list[tuple[float, int]] = []

    def hear_byte(self, byte: int, now: float) -> None:
        self.heard.append((now, byte))


def mint(address: int = 2, delay: float = 0.002) -> EmulatedMint:
    return EmulatedMint(address, delay=Delay(delay))


# Time


def test_a_reply_comes_when_request_delay_and_reply_have_passed() -> None:
    line = line_of(mint())
    line.prompt = False
    line.send(READ_2, 1.0)
    [(when, data)] = arrivals(line, 2.0)
    assert data == REPLY
    assert when == pytest.approx(1.0 + 8 * TAU + 0.002 + 6 * TAU)


def test_a_host_that_asks_in_mid_frame_gets_the_bytes_that_have_ended() -> None:
    line = line_of(mint())
    line.send(READ_2, 0.0)
    start = 8 * TAU + 0.002
    assert line.receive(start + 0.9 * TAU) == b""
    assert hexed(line.receive(start + 1.1 * TAU)) == "02"
    assert hexed(line.receive(start + 3.5 * TAU)) == "30 31"
    assert hexed(line.receive(1.0)) == "30 03 32"


def test_the_first_byte_is_an_event_unless_the_host_asks_in_time_by_itself() -> None:
    line = line_of(mint())
    line.send(READ_2, 0.0)
    assert [data for _, data in arrivals(line, 1.0)] == ["02", "30 31 30 03 32"]


@pytest.mark.parametrize("chunk", [0, 1000])
def test_a_long_frame_comes_in_pieces_without_a_pause_that_would_look_like_its_end(chunk: int) -> None:
    """MSC's BREAD packet lasts 148 ms at 9600 baud, and its inter-byte timeout is 100 ms."""
    line = Line(LineSettings(9600), [make_device("msc", 1)], chunk=chunk)
    line.send(bytes.fromhex("02 01 00 08 00 00 42 52 45 41 44 2C 07 D8 02 72"), 0.0)
    times = [when for when, data in arrivals(line, 0.5)][1:]
    assert times[-1] - times[0] > 0.1
    assert max(after - before for before, after in itertools.pairwise(times)) <= PIECE + 10 / 9600


def test_chunks_split_a_reply_evenly() -> None:
    line = line_of(mint(), chunk=2)
    line.prompt = False
    line.send(READ_2, 0.0)
    assert [data for _, data in arrivals(line, 1.0)] == ["02 30", "31 30", "03 32"]


def test_a_reply_that_was_complete_before_the_host_sends_again_reaches_it_at_once() -> None:
    line = line_of(mint())
    line.prompt = False
    line.send(READ_2, 0.0)
    end = 14 * TAU + 0.002
    line.send(READ_3, end + TAU)
    assert line.next_event() == pytest.approx(end)
    assert hexed(line.receive(end + TAU)) == REPLY
    assert line.next_event() == pytest.approx(end + 9 * TAU)


def test_latency_holds_back_what_the_wire_has_delivered() -> None:
    line = line_of(mint(), latency=0.016)
    line.prompt = False
    line.send(READ_2, 0.0)
    [(when, _)] = arrivals(line, 1.0)
    assert when == pytest.approx(14 * TAU + 0.002 + 0.016)


def test_without_pace_bytes_take_no_time() -> None:
    line = line_of(mint(), paced=False)
    line.send(READ_2, 5.0)
    assert arrivals(line, 6.0) == [(5.002, REPLY)]


def test_seven_bits_with_parity_take_as_long_as_eight_without() -> None:
    assert Line(LineSettings(9600, 7, "E")).tau == Line(LineSettings(9600)).tau == pytest.approx(10 / 9600)


def test_early_and_repeated_calls_do_nothing() -> None:
    line = line_of(mint())
    line.prompt = False
    line.send(READ_2, 1.0)
    assert line.receive(1.0) == line.receive(1.0) == line.receive(0.5) == b""
    assert hexed(line.receive(2.0)) == REPLY
    assert line.receive(2.0) == b""
    assert line.next_event() == float("inf")


def test_the_host_queues_behind_what_it_is_still_sending() -> None:
    line = line_of(ear := Ear())
    line.send(b"ab", 0.0)
    line.send(b"cd", TAU / 2)
    line.receive(1.0)
    assert [byte for _, byte in ear.heard] == list(b"abcd")
    assert [when for when, _ in ear.heard] == pytest.approx([TAU, 2 * TAU, 3 * TAU, 4 * TAU])


# Who hears what


def test_a_device_that_listens_hears_the_others_too() -> None:
    line = line_of(mint(), ear := Ear())
    ask(line, hexed(READ_2))
    assert bytes(byte for _, byte in ear.heard) == READ_2 + bytes.fromhex(REPLY)
    assert ear.heard[8][0] == pytest.approx(8 * TAU + 0.002 + TAU)


def test_a_request_that_came_glued_to_rubbish_is_heard_all_the_same() -> None:
    assert ask(line_of(mint()), "00 FF " + hexed(READ_2)) == REPLY


def test_the_line_knows_its_devices_by_address() -> None:
    line = line_of(first := mint(2), mint(3))
    assert line.device(2) is first
    line.remove(first)
    with pytest.raises(KeyError):
        line.device(2)
    assert ask(line, hexed(READ_2)) == ""
    assert ask(line, hexed(READ_3), 1.0) == REPLY


class Insister(Device):
    """Says its name every 10 ms until it has heard anything."""

    def hear_byte(self, byte: int, now: float) -> None:
        self.wakeup = float("inf")

    def wake(self, now: float) -> None:
        self.reply(b"here", now, 0.0)
        self.wakeup = now + 0.01


def test_a_device_may_speak_unexpected_when_its_own_timer_runs_out() -> None:
    device = Insister(1)
    device.wakeup = 0.005
    device.attentive = True
    line = line_of(device, mint(3))
    line.prompt = False
    assert [round(when - 4 * TAU, 6) for when, _ in arrivals(line, 0.03)] == [0.005, 0.015, 0.025]
    assert ask(line, hexed(READ_3), 0.03) == REPLY
    device.wakeup = 1.0
    device.faults.dead = 1.0
    line.restart(device, 0.9)
    assert ask(line, "00", 0.95, 0.2) == ""


def test_a_device_whose_timer_runs_out_during_a_reply_disturbs_it_from_then_on() -> None:
    device, start = Insister(1), 8 * TAU + 0.002
    device.wakeup = start + 2.5 * TAU
    line = line_of(mint(), device)
    line.prompt = False
    line.send(READ_2, 0.0)
    (when, data), *rest = arrivals(line, start + 10 * TAU)
    assert data == "02 30"
    assert when == pytest.approx(start + 2.5 * TAU)
    assert " ".join(data for _, data in rest) != "31 30 03 32"
    assert line.collisions == 1


def test_each_device_has_a_timer_of_its_own() -> None:
    """The second one's is due while the first one's has been set again, and before the first one's is due again."""
    devices = [Insister(1), Insister(2), Insister(3)]
    for device, due in zip(devices, (0.005, 0.008, 0.011), strict=True):
        device.wakeup = due
    line = line_of(*devices)
    line.prompt = False
    found = [round(when - 4 * TAU, 6) for when, _ in arrivals(line, 0.024)]
    assert found == [0.005, 0.008, 0.011, 0.015, 0.018, 0.021]


# Collisions


def test_two_devices_at_one_address_garble_each_other() -> None:
    one, other = mint(2), mint(2, delay=0.0021)
    one.comms[1], other.comms[1] = 5, 6
    line = line_of(one, other)
    heard = ask(line, hexed(READ_2))
    assert line.collisions == 1
    assert heard not in ("02 30 31 35 03 37", "02 30 31 36 03 34")


def test_two_equal_replies_at_the_same_moment_look_like_one() -> None:
    line = line_of(mint(2), mint(2))
    assert ask(line, hexed(READ_2)) == REPLY
    assert line.collisions == 1


@pytest.mark.parametrize("number", [3, 4])
def test_several_equal_replies_at_the_same_moment_look_like_one_and_the_line_goes_on(number: int) -> None:
    line = line_of(*(mint(2) for _ in range(number)), mint(3))
    assert ask(line, hexed(READ_2)) == REPLY
    assert line.collisions == number - 1
    assert ask(line, hexed(READ_3), 1.0) == REPLY


def test_transmissions_that_are_announced_in_any_order_begin_in_order_of_time() -> None:
    """All but the first wait for it; two of them begin at the same moment."""
    delays = (0.004, 0.006, 0.002, 0.008, 0.006)
    line = line_of(*(mint(2, delay) for delay in delays))
    line.send(READ_2, 0.0)
    heard = arrivals(line, 0.5)
    assert [when for when, data in heard if data.startswith("02")] == pytest.approx(
        [8 * TAU + delay + TAU for delay in sorted(set(delays))]
    )
    assert " ".join(data for _, data in heard) == " ".join([REPLY] * 4)
    assert line.collisions == 1


def test_a_device_receives_what_is_left_of_a_collision() -> None:
    line = line_of(first := Ear(), mint(2), mint(2), last := Ear())
    ask(line, hexed(READ_2))  # two equal replies
    for ear in (first, last):
        assert bytes(byte for _, byte in ear.heard) == READ_2 + bytes.fromhex(REPLY)
    line = line_of(mint(2, delay=0.0), ear := Ear(), driver_release_time=3 * TAU)
    ask(line, hexed(READ_2))
    heard = bytes(byte for _, byte in ear.heard)
    assert heard.startswith(READ_2)
    assert heard.endswith(bytes.fromhex("03 32"))
    assert heard != READ_2 + bytes.fromhex(REPLY)


def test_what_had_arrived_before_a_collision_stays_as_it_was() -> None:
    line = line_of(mint())
    line.send(READ_2, 0.0)
    start = 8 * TAU + 0.002
    assert hexed(line.receive(start + 2.5 * TAU)) == "02 30"
    line.send(b"\x00", start + 2.5 * TAU)  # the host talks into the reply
    rest = hexed(line.receive(1.0))
    assert rest.endswith("03 32")
    assert len(rest.split()) == 2  # what came while it talked it did not hear


@pytest.mark.parametrize("prompt", [False, True])
def test_what_is_heard_of_a_collision_reaches_the_host_as_it_comes(prompt: bool) -> None:
    """However long the other talker goes on."""
    line = line_of(mint())
    line.prompt = prompt
    line.send(READ_2, 0.0)
    start = 8 * TAU + 0.002
    line.receive(start + 2 * TAU)
    line.send(b"\x00", start + 2.5 * TAU)
    assert [when for when, _ in arrivals(line, 1.0)] == pytest.approx([start + 5 * TAU, start + 6 * TAU])


def test_a_request_that_collides_with_an_overdue_reply_is_lost_and_not_misheard() -> None:
    line = line_of(mint(2, delay=0.05), mint(3))
    line.send(READ_2, 0.0)
    line.send(READ_3, 0.0505)
    heard = " ".join(data for _, data in arrivals(line, 1.0))
    assert line.collisions == 1
    assert REPLY not in heard


@given(st.binary(min_size=1, max_size=8), st.sampled_from("NEOMS"), st.sampled_from([1, 2]))
@settings(max_examples=50)
def test_a_lone_talker_is_heard_as_it_spoke_in_any_framing(data: bytes, parity: str, stopbits: int) -> None:
    collision = Collision(LineSettings(9600, 8, parity, stopbits), 3.0, Random(1))
    collision.add(3.0, data, None)
    heard = list(collision.heard(Ear()))
    assert bytes(byte for _, byte in heard) == data
    tau = LineSettings(9600, 8, parity, stopbits).byte_time
    assert [when for when, _ in heard] == pytest.approx([3.0 + n * tau for n in range(len(data))])
    assert list(collision.heard(None)) == []
    assert list(collision.heard(None, echo=True)) == heard


@given(st.binary(min_size=2, max_size=8), st.binary(min_size=1, max_size=8), st.floats(0, 10), st.integers())
@settings(max_examples=100)
def test_a_second_talker_changes_nothing_that_ended_before_it(
    first: bytes, second: bytes, offset: float, seed: int
) -> None:
    alone, both = (Collision(SETTINGS, 0.0, Random(seed)) for _ in range(2))
    for collision in (alone, both):
        collision.add(0.0, first, None)
    both.add(offset * TAU, second, None)
    ear = Ear()
    ended = len(list(alone.heard(ear, until=offset * TAU)))
    assert list(both.heard(ear))[:ended] == list(alone.heard(ear))[:ended]


# Echo, turnaround, cut


def test_an_echo_gives_the_host_its_own_bytes_first() -> None:
    line = line_of(mint(), echo=Echo())
    assert ask(line, hexed(READ_2)) == hexed(READ_2) + " " + REPLY


def test_a_late_echo_still_comes_before_the_reply() -> None:
    line = line_of(mint(delay=0.001), echo=Echo(delay=0.01))
    line.send(READ_2, 0.0)
    [(when, data)] = arrivals(line, 1.0)
    assert when == pytest.approx(8 * TAU + 0.01)
    assert data == hexed(READ_2) + " " + REPLY


@pytest.mark.parametrize("prompt", [False, True])
@pytest.mark.parametrize("late", [2.5, 20])
def test_a_late_echo_comes_at_its_time_although_the_host_sends_on(late: float, prompt: bool) -> None:
    line = line_of(echo=Echo(late * TAU))
    line.prompt = prompt
    line.send(READ_2, 0.0)
    line.send(READ_3, 0.0)
    heard = arrivals(line, 1.0)
    assert [data for _, data in heard] == [hexed(READ_2), hexed(READ_3)]
    assert [when for when, _ in heard] == pytest.approx([(8 + late) * TAU, (16 + late) * TAU])


@pytest.mark.parametrize("prompt", [False, True])
def test_a_late_echo_comes_at_its_time_although_a_device_replies(prompt: bool) -> None:
    line = line_of(mint(delay=0.0), echo=Echo(delay=2.5 * TAU))
    line.prompt = prompt
    line.send(READ_2, 0.0)
    heard = arrivals(line, 1.0)
    assert [data for _, data in heard] == [hexed(READ_2) + " 02 30", "31 30 03 32"]
    assert [when for when, _ in heard] == pytest.approx([10.5 * TAU, 14 * TAU])


def test_bytes_that_an_adapter_holds_back_come_at_their_time_although_the_host_sends_on() -> None:
    line = line_of(mint(), latency=3 * TAU)
    line.prompt = False
    line.send(READ_2, 0.0)
    end = 14 * TAU + 0.002
    assert line.receive(end + TAU) == b""
    line.send(READ_3, end + TAU)
    [(when, data)] = arrivals(line, 1.0)
    assert data == REPLY
    assert when == pytest.approx(end + 3 * TAU)


def test_a_corrupt_echo_differs_by_one_bit() -> None:
    echo = bytes.fromhex(ask(line_of(echo=Echo(corrupt=1.0)), hexed(READ_2)))
    assert sum((a ^ b).bit_count() for a, b in zip(echo, READ_2, strict=True)) == 1


def test_an_echo_is_corrupt_as_often_as_is_set() -> None:
    line = line_of(echo=Echo(corrupt=0.2))
    intact = sum(ask(line, hexed(READ_2), now, 0.5) == hexed(READ_2) for now in range(200))
    assert 140 < intact < 180


def test_a_device_that_holds_the_line_after_its_reply_garbles_the_next_request() -> None:
    first = mint(2)
    first.driver_release_time = 2 * TAU
    line = line_of(first, mint(3))
    line.send(READ_2, 0.0)
    end = 14 * TAU + 0.002
    line.receive(end)
    line.send(READ_3, end)
    assert line.receive(2.0) == b""
    line.send(READ_2, 2.0)
    line.receive(2.0 + end)
    assert ask(line, hexed(READ_3), 2.0 + end + 2.5 * TAU) == REPLY


def test_a_host_that_holds_the_line_garbles_a_quick_reply() -> None:
    line = line_of(mint(delay=0.0), driver_release_time=3 * TAU)
    garbled = ask(line, hexed(READ_2))
    assert garbled != REPLY
    assert garbled.endswith("03 32")
    assert ask(line_of(mint(delay=0.002), driver_release_time=3 * TAU), hexed(READ_2)) == REPLY


def test_nothing_passes_a_cut_until_it_is_mended() -> None:
    line = line_of(mint())
    line.cut(0.0)
    assert ask(line, hexed(READ_2), 0.0) == ""
    line.restore(1.0)
    assert ask(line, hexed(READ_2), 1.0) == REPLY


def test_a_cut_ends_a_reply_in_the_middle() -> None:
    line = line_of(mint())
    line.send(READ_2, 0.0)
    line.cut(8 * TAU + 0.002 + 3.5 * TAU)
    assert hexed(line.receive(1.0)) == "02 30 31"


def test_a_request_that_was_cut_in_the_middle_is_forgotten_at_the_next_reset_byte() -> None:
    line = line_of(mint())
    line.send(WRITE_2, 0.0)
    line.cut(5.5 * TAU)
    line.restore(0.5)
    assert ask(line, hexed(READ_2), 1.0) == REPLY


def test_a_device_hears_a_request_up_to_the_cut_and_one_that_is_not_cut_off_hears_all_of_it_once() -> None:
    line = line_of(near := Ear(), far := Ear())
    line.send(WRITE_2, 0.0)
    line.cut(5.5 * TAU, far)
    line.receive(1.0)
    assert bytes(byte for _, byte in near.heard) == WRITE_2
    assert bytes(byte for _, byte in far.heard) == WRITE_2[:5]


def test_a_request_across_a_short_cut_is_not_heard() -> None:
    line = line_of(mint())
    line.send(WRITE_2, 0.0)
    line.cut(5.5 * TAU)
    line.restore(6.5 * TAU)
    assert arrivals(line, 0.5) == []
    assert ask(line, hexed(READ_2), 1.0) == REPLY


def test_a_cut_may_spare_the_devices_before_it() -> None:
    line = line_of(mint(2), far := mint(3))
    line.cut(0.0, far)
    assert ask(line, hexed(READ_2)) == REPLY
    assert ask(line, hexed(READ_3), 1.0) == ""


def test_a_device_that_is_cut_off_and_speaks_by_its_own_timer_is_not_heard() -> None:
    device = Insister(1)
    device.wakeup = 0.005
    line = line_of(device, mint(3))
    line.cut(0.0, device)
    assert arrivals(line, 0.1) == []
    assert ask(line, hexed(READ_3), 0.1) == REPLY
    line.restore(1.0)
    assert [data for _, data in arrivals(line, 1.03)][:2] == ["68", "65 72 65"]


def test_each_cut_disconnects_further_devices_until_all_are_restored() -> None:
    line = line_of(mint(2), mint(3), mint(4))
    line.cut(0.0, line.device(2))
    line.cut(0.0, line.device(3))
    read = [hcp2.Read(1).open(address, hcp2.PROFILE.timings).request for address in (2, 3, 4)]
    assert [ask(line, hexed(request), 1.0 + n) for n, request in enumerate(read)] == ["", "", REPLY]
    line.restore(5.0)
    assert [ask(line, hexed(request), 6.0 + n) for n, request in enumerate(read)] == [REPLY] * 3


def test_a_cut_after_a_restore_in_the_middle_of_a_request_lasts_beyond_its_end() -> None:
    line = line_of(mint())
    line.send(WRITE_2, 0.0)
    line.cut(2.5 * TAU)
    line.restore(4.5 * TAU)
    line.cut(6.5 * TAU)
    assert ask(line, hexed(READ_2), 1.0) == ""


def test_a_reply_behind_that_of_another_device_is_lost_in_a_cut() -> None:
    line = line_of(mint(2, delay=0.05), far := mint(3, delay=0.1))
    line.send(READ_2, 0.0)
    line.send(READ_3, 0.01)
    line.cut(0.04, far)
    [(when, _), _] = arrivals(line, 1.0)
    assert when == pytest.approx(8 * TAU + 0.05 + TAU)


# Anything, in any order


@pytest.mark.slow
@given(
    st.integers(),
    st.lists(st.tuples(st.sampled_from(["send", "wait", "cut", "restore", "restart", "look"]), st.floats(0, 0.01))),
    st.booleans(),
    st.sampled_from([None, Echo(), Echo(0.003), Echo(corrupt=0.5)]),
)
@settings(max_examples=150)
def test_whatever_happens_the_line_comes_to_rest_and_then_works(
    seed: int, happenings: list[tuple[str, float]], paced: bool, echo: Echo | None
) -> None:
    chance = Random(seed)
    devices = [mint(2), mint(2, delay=0.0), mint(3)]
    for device in devices:
        device.driver_release_time = TAU
        device.faults = Faults.parse([f"{name}=0.1" for name in (*HEARING, *SPEAKING) if name != "dead"])
    line = Line(
        SETTINGS,
        devices,
        chance=chance,
        paced=paced,
        echo=echo,
        chunk=seed % 3,
        latency=seed % 2 * 0.001,
        driver_release_time=TAU,
    )
    now = 0.0
    for what, seconds in happenings:
        now += seconds
        match what:
            case "send":
                line.send(chance.choice([READ_2, READ_3, WRITE_2, b"\x07", b"\x00\xff"]), now)
            case "cut":
                line.cut(now, *chance.choice([(), devices[:1]]))
            case "restore":
                line.restore(now)
            case "restart":
                line.restart(devices[0], now)
            case "look":
                line.receive(now)
    steps = 0
    while (when := line.next_event()) != float("inf"):
        assert when >= now - 1e-9 or steps == 0
        now = max(now, when)
        line.receive(now)
        steps += 1
        assert steps < 10_000
    for device in devices:
        device.faults = Faults()
    line.echo = None
    line.restore(now)
    ask(line, hexed(READ_3), now + 10)  # its first byte may be the checksum of a frame that was cut
    assert ask(line, hexed(READ_3), now + 20) == REPLY


# Delays


def test_a_spread_delay_is_drawn_from_the_chance_that_was_handed_in() -> None:
    times = []
    for _ in range(2):
        line = line_of(EmulatedMint(2, delay=Delay(0.05, 0.1)), seed=7)
        line.prompt = False
        line.send(READ_2, 0.0)
        times.append(arrivals(line, 1.0)[0][0] - 14 * TAU)
    assert times[0] == times[1]
    assert 0.05 <= times[0] <= 0.1


def test_late_replies_are_a_share_of_the_replies() -> None:
    delay, chance = Delay(0.002, late_replies=0.1, late_reply_delay=(0.1, 0.145)), Random(1)
    drawn = [delay.draw(chance) for _ in range(1000)]
    assert 50 < sum(d > 0.01 for d in drawn) < 150
    assert all(d == 0.002 or 0.1 <= d <= 0.145 for d in drawn)


def test_chance_that_was_not_handed_in_is_asked_for() -> None:
    line = Line(SETTINGS, [EmulatedMint(2, delay=Delay(0.05, 0.1))])
    line.send(READ_2, 0.0)
    with pytest.raises(ValueError, match=r"random\.Random"):
        line.receive(1.0)


@pytest.mark.parametrize(
    ("text", "delay"),
    [("2", Delay(0.002)), ("50-100", Delay(0.05, 0.1)), ("0", Delay(0.0)), ("1.5-1.5", Delay(0.0015))],
)
def test_delays_are_read_as_milliseconds(text: str, delay: Delay) -> None:
    assert Delay.parse(text) == delay


@pytest.mark.parametrize("text", ["", "x", "-5", "50-", "100-50", "1-2-3", "nan", "inf"])
def test_a_delay_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(InvalidCommand, match="reply delay"):
        Delay.parse(text)


def test_a_transmission_that_joins_a_collision_is_heard_though_the_host_has_read_from_it_before() -> None:
    collision = Collision(SETTINGS, 0.0, Random(1))
    collision.add(0.0, b"\x55", None)
    ear = Ear()
    assert [byte for _, byte in collision.heard(ear)] == [0x55]
    collision.add(10 * TAU, b"\x2a", None)
    assert [byte for _, byte in collision.heard(ear)] == [0x55, 0x2A]


def test_bytes_that_the_host_has_not_received_yet_are_kept_when_more_arrive() -> None:
    line = line_of(mint())
    line._arrive(b"ab", 0.1)
    line._arrive(b"c", 0.2)
    assert line.receive(1.0) == b"abc"


def test_a_device_that_was_removed_receives_and_sends_nothing_more() -> None:
    line = line_of(mint(), ear := Ear(), sender := Insister(1))
    line.remove(ear)
    sender.wakeup = 0.001
    line.remove(sender)
    assert ask(line, hexed(READ_2)) == REPLY
    assert ear.heard == []


def test_a_device_that_is_added_later_has_the_time_and_the_chance_of_the_line() -> None:
    line = line_of()
    late = EmulatedMint(2, delay=Delay(0.05, 0.1))
    line.add(late)
    line.send(READ_2, 1.0)
    [(first, _), (last, _)] = arrivals(line, 2.0)
    assert 1.05 < first - 9 * TAU < 1.1
    assert last - first == pytest.approx(5 * TAU)


def test_two_requests_in_one_piece_reach_both_devices() -> None:
    line = line_of(mint(2), mint(3, delay=0.005))
    assert ask(line, hexed(READ_2 + READ_3)) == f"{REPLY} {REPLY}"


def test_a_talker_never_collides_with_its_own_release_of_the_line() -> None:
    device = mint(2)
    device.driver_release_time = 3 * TAU
    line = line_of(device, driver_release_time=3 * TAU)
    line.send(b"\x07", 0.0)
    line.send(READ_2[1:], 2 * TAU)
    assert [data for _, data in arrivals(line, 1.0)] == ["02", REPLY[3:]]
    assert line.collisions == 0


def test_a_restart_happens_at_its_time_and_not_before() -> None:
    """A reply that has begun is finished, and one that was transmitted before is complete."""
    device = mint()
    line = line_of(device)
    device.comms[1] = 5
    line.send(READ_2, 0.0)
    line.restart(device, 1.0)
    assert hexed(line.receive(1.0)) == "02 30 31 35 03 37"
    assert device.comms[1] == 0


def test_a_reply_that_would_begin_at_the_moment_of_a_restart_is_not_sent() -> None:
    line = line_of(device := mint(delay=0.0))
    line.send(READ_2, 0.0)
    line.restart(device, 8 * line.tau)
    assert arrivals(line, 1.0) == []


def test_a_cut_of_some_devices_leaves_the_reply_of_another_alone() -> None:
    line = line_of(mint(2), far := mint(3))
    line.send(READ_2, 0.0)
    line.cut(8 * TAU + 0.002 + 2.5 * TAU, far)
    assert hexed(line.receive(1.0)) == REPLY


def test_a_reply_that_waits_for_its_turn_is_lost_in_a_cut_and_another_is_not() -> None:
    line = line_of(mint(2, delay=0.1), far := mint(3, delay=0.05))
    line.send(READ_2, 0.0)
    line.send(READ_3, 0.01)
    line.cut(0.04, far)
    [(when, _), _] = arrivals(line, 1.0)
    assert when == pytest.approx(8 * TAU + 0.1 + TAU)


@pytest.mark.parametrize(
    "values",
    [
        {"low": -0.001},
        {"low": 0.1, "high": 0.05},
        {"high": float("inf")},
        {"late_reply_delay": (0.2, 0.1)},
        {"late_reply_delay": (-0.1, 0.1)},
        {"late_reply_delay": (0.1, float("inf"))},
        {"late_replies": 1.1},
        {"late_replies": -0.1},
    ],
)
def test_a_delay_that_no_device_can_have_is_refused(values: dict[str, Any]) -> None:
    with pytest.raises(InvalidCommand, match=r"reply delay|share of overdue replies is from 0 to 1"):
        Delay(**values)
    Delay(0.0, 0.0, late_replies=1.0, late_reply_delay=(0.0, 0.0))


def test_a_device_without_settable_values_refuses_them() -> None:
    with pytest.raises(InvalidCommand, match="Ear takes no initial values"):
        Ear().preset("1", 5.0)


@pytest.mark.parametrize(("value", "fits"), [(0, True), (255, True), (-1, False), (256, False), (1.5, False)])
def test_a_device_stores_whole_numbers_of_its_range(value: float, fits: bool) -> None:
    if fits:
        assert held(value, 0, 255, "register 1") == value
    else:
        with pytest.raises(InvalidCommand, match=f"register 1 holds a whole number, 0 to 255, not {value:g}"):
            held(value, 0, 255, "register 1")


def test_a_device_that_restarts_takes_back_its_own_reply_alone() -> None:
    devices = [mint(address, delay=address * 0.05) for address in (1, 2, 3)]
    for device in devices:
        device.comms[1] = device.address
    line = line_of(*devices)
    for number, device in enumerate(devices):
        request = hcp2.Read(1).open(device.address, hcp2.PROFILE.timings).request
        line.send(request, number * 0.01)
    line.restart(devices[1], 0.04)
    replies = "".join(data for _, data in arrivals(line, 1.0)).replace(" ", "")
    assert bytes.fromhex(replies) == b"\x02011\x03\x33" + b"\x02013\x03\x31"


@pytest.mark.parametrize("cut", [False, True])
def test_the_transmissions_that_are_left_after_a_cut_or_a_restart_begin_in_order_of_time(cut: bool) -> None:
    """The transmission that is lost is the first of those that wait."""
    devices = [mint(address, delay) for address, delay in ((1, 0.05), (2, 0.2), (3, 0.12), (4, 0.07))]
    for device in devices:
        device.comms[1] = device.address
    line = line_of(*devices)
    for number, device in enumerate(devices):
        line.send(hcp2.Read(1).open(device.address, hcp2.PROFILE.timings).request, number * 0.01)
    if cut:
        line.cut(0.045, devices[3])
    else:
        line.restart(devices[3], 0.045)
    replies = "".join(data for _, data in arrivals(line, 1.0)).replace(" ", "")
    assert bytes.fromhex(replies) == b"\x02011\x03\x33" + b"\x02013\x03\x31" + b"\x02012\x03\x30"
    assert line.collisions == 0


class Low:
    """A source of chance by which a low level always wins."""

    def getrandbits(self, k: int) -> int:
        return 0


def test_after_a_byte_without_a_stop_bit_the_next_start_bit_begins_a_byte() -> None:
    bit = TAU / 10
    collision = Collision(SETTINGS, 0.0, cast("Random", Low()))
    collision.add(0.0, b"\0", None)
    collision.add(5 * bit, b"\0", None)  # low up to bit 13, over the stop bit of the first
    collision.add(20 * bit, b"\x55", None)
    heard = list(collision.heard(Ear()))
    assert [byte for _, byte in heard] == [0x00, 0x55]
    assert heard[1][0] == pytest.approx(20 * bit)


def test_all_devices_hear_a_frame_that_none_of_its_route_takes() -> None:
    routed, others = [Ear(), Ear()], [Ear(), Ear()]
    for ear in routed:
        ear.attentive = False
        ear.routes = (READ_2[:3],)
    others[0].attentive = False
    ask(line_of(*routed, *others), hexed(READ_2))
    assert [bytes(byte for _, byte in ear.heard) for ear in (*routed, *others)] == [READ_2] * 4


def test_a_device_sends_one_transmission_after_another_until_it_restarts() -> None:
    device = Ear()
    device.tau = TAU
    assert device.reply(b"abc", 1.0, 0.01) == pytest.approx(1.01 + 3 * TAU)
    assert device.reply(b"d", 1.0, 0.0) == pytest.approx(1.01 + 4 * TAU)
    assert [start for start, _ in device.outbox] == pytest.approx([1.01, 1.01 + 3 * TAU])
    device.restart(1.005)
    assert device.outbox == []
    assert device.reply(b"e", 1.006, 0.0) == pytest.approx(1.006 + TAU)


def test_a_dead_device_sends_nothing_of_its_own_accord() -> None:
    device = Insister(1)
    device.wakeup = 0.005
    device.faults.dead = 1.0
    line = line_of(device)
    line.prompt = False
    assert arrivals(line, 0.02) == []
    device.faults.dead = 0.0
    assert [round(when - 4 * TAU, 6) for when, _ in arrivals(line, 0.03)] == [0.025]


def test_a_device_that_is_away_sends_nothing_of_its_own_accord() -> None:
    device = Insister(1)
    device.wakeup = 0.005
    device.away_until = 0.02
    line = line_of(device)
    line.prompt = False
    assert [round(when - 4 * TAU, 6) for when, _ in arrivals(line, 0.03)] == [0.025]
