"""What an exchange takes of the line."""

from __future__ import annotations

from dataclasses import replace

import pytest

from busmaster.arbiter.schedule import line_time
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.msc import codec as msc

TAU = hcp2.PROFILE.line.byte_time


def test_line_time_of_a_read_counts_bytes_both_ways_and_one_wait() -> None:
    """HCP2 read: 8 bytes there; STX, 2, 7 typical, ETX and a checksum back."""
    read = hcp2.Read(1).open(1, hcp2.PROFILE.timings)
    assert line_time(read, TAU, 0.002) == pytest.approx((8 + 12) * TAU + 0.002)
    assert line_time(read, TAU) == pytest.approx((8 + 12) * TAU + 0.025)


def test_line_time_of_a_conversation_counts_each_step_and_the_closing_ack() -> None:
    """MSC DREAD: a packet of 16 bytes, ACK, a packet of 18 bytes, ACK."""
    tau = msc.PROFILE.line.byte_time
    read = msc.DataRead(2008).open(1, msc.PROFILE.timings)
    assert line_time(read, tau, 0.01) == pytest.approx((16 + 1 + 18 + 1) * tau + 2 * 0.01)
    slow = replace(msc.PROFILE.timings.packet, late_after=0.08)
    read = msc.DataRead(2008).open(1, replace(msc.PROFILE.timings, packet=slow))
    late_after = msc.PROFILE.timings.read.late_after
    assert line_time(read, tau) == pytest.approx((16 + 1 + 18 + 1) * tau + (late_after + 0.08) / 2)


def test_line_time_of_a_request_with_an_odd_number_of_bytes_counts_the_closing_ack_too() -> None:
    """MSC RFLAGS: a packet of 15 bytes, ACK, a packet of 47 typical bytes, ACK."""
    tau = msc.PROFILE.line.byte_time
    read = msc.ReadFlags().open(1, msc.PROFILE.timings)
    assert line_time(read, tau, 0.01) == pytest.approx((15 + 1 + 47 + 1) * tau + 2 * 0.01)


def test_line_time_of_a_broadcast_counts_its_bytes_and_no_reply() -> None:
    """A write of Mentor II to address 0: EOT, four digits of the address, STX, four of the parameter, the value, ETX,
    and a checksum."""
    write = mentor.Write(1, 18, 5).open(0, mentor.PROFILE.timings)
    assert not write.answered
    tau, released = mentor.PROFILE.line.byte_time, write.timing.driver_release_time
    assert line_time(write, tau) == pytest.approx(len(write.request) * tau + released)
    assert line_time(write, tau, 0.05) == line_time(write, tau)
