"""What is learned of a node's replies, by itself and without a line: windows, silences, and until when they count."""

from __future__ import annotations

import pytest

from busmaster.arbiter.learned import (
    AT_FIRST,
    EPOCH,
    LEAST,
    LEAST_SILENCE,
    MARGIN,
    NEVER,
    TRUSTED_AFTER,
    TRUSTED_AGAIN_AFTER,
    LearnedTimes,
    Learning,
    StepTimes,
)
from busmaster.arbiter.on_wire import Step
from busmaster.protocols.hcp2 import codec as hcp2
from tests.arbiter.bench import TAU

TIMINGS = hcp2.PROFILE.timings


def test_the_window_is_half_as_long_again_as_the_largest_reply_time_of_the_last_epochs_and_at_least_the_least() -> None:
    times = StepTimes()
    for place in range(TRUSTED_AFTER):
        assert times.timing(TIMINGS.read, TAU, AT_FIRST) is TIMINGS.read, f"{place} replies are too few"
        times.note(0.001, 0.002, 0.0)
    assert times.timing(TIMINGS.read, TAU, AT_FIRST).window == LEAST
    times.note(0.010, 0.012, 0.0)
    learned = times.timing(TIMINGS.read, TAU, AT_FIRST)
    assert learned.window == pytest.approx(1.5 * 0.010 + 0.002)
    assert learned.max_reply_delay == TIMINGS.read.max_reply_delay, (
        "what is overdue is overdue for as long as the document says"
    )
    assert learned.inter_byte_timeout == pytest.approx(LEAST_SILENCE * TAU)
    assert learned.silence == TIMINGS.read.inter_byte_timeout
    for _ in range(2 * EPOCH):
        times.note(0.001, 0.002, 0.0)
    assert times.window == LEAST


def test_each_time_that_becomes_longer_is_a_change_and_the_same_again_is_none() -> None:
    times = StepTimes()
    for _ in range(TRUSTED_AFTER):
        times.note(0.01, 0.02, 0.001)
    longer = [(0.011, 0.02, 0.001), (0.011, 0.021, 0.001), (0.011, 0.021, 0.002)]
    assert [(times.note(*each), times.note(*each)) for each in longer] == [(True, False)] * 3


def test_what_an_adapter_hands_over_late_or_in_pieces_is_waited_for() -> None:
    times = StepTimes()
    for _ in range(TRUSTED_AFTER):
        times.note(0.001, 0.018, 0.004)
    learned = times.timing(TIMINGS.read, TAU, AT_FIRST)
    assert learned.window == pytest.approx(0.018 + MARGIN)
    assert learned.inter_byte_timeout == pytest.approx(0.008)


def test_a_pause_is_what_is_between_two_pieces_of_a_reply_however_early_they_come() -> None:
    step = Step(TIMINGS.read, 0.0, TAU)
    step.begun_at = 0.01
    for now in (0.01, 0.02, 0.025):
        step.note_pause(now)
    assert step.pause == pytest.approx(0.01)


def test_a_reply_that_was_slower_than_any_is_forgotten_after_two_epochs() -> None:
    node, read = Learning(), hcp2.Read(1)
    node.timings(read, TIMINGS, AT_FIRST)
    for _ in range(TRUSTED_AFTER):
        node.note(read, False, 0.010, 0.010, 0.0, TAU)
    assert node.timings(read, TIMINGS, AT_FIRST).read.window == pytest.approx(0.017)
    for _ in range(2 * EPOCH):
        node.note(read, False, 0.001, 0.001, 0.0, TAU)
        window = node.timings(read, TIMINGS, AT_FIRST).read.window
    assert window == LEAST


def test_the_slowest_reply_is_remembered_for_a_whole_epoch() -> None:
    times = StepTimes()
    for _ in range(EPOCH):
        times.note(0.001, 0.001, 0.0)
    times.note(0.010, 0.010, 0.0)
    for _ in range(2 * EPOCH - 2):
        times.note(0.001, 0.001, 0.0)
    assert times.window == pytest.approx(1.5 * 0.010 + 0.002)
    times.note(0.001, 0.001, 0.0)
    assert times.window == LEAST


def test_a_raised_max_reply_delay_and_a_shorter_byte_time_count_at_once() -> None:
    node, read = Learning(), hcp2.Read(1)
    for _ in range(TRUSTED_AFTER):
        node.timings(read, TIMINGS, AT_FIRST)
        node.note(read, False, 0.001, 0.001, 0.0, 2 * TAU)
    pauses = [node.timings(read, TIMINGS, AT_FIRST).read.inter_byte_timeout]
    node.note(read, False, 0.001, 0.001, 0.0, TAU)
    pauses.append(node.timings(read, TIMINGS, AT_FIRST).read.inter_byte_timeout)
    assert pauses == pytest.approx([LEAST_SILENCE * 2 * TAU, LEAST_SILENCE * TAU])
    raised = TIMINGS.with_max_reply_delay(0.4)
    assert node.timings(read, raised, AT_FIRST).read.max_reply_delay == raised.read.max_reply_delay


def test_no_learned_time_exceeds_the_documents() -> None:
    times = StepTimes()
    for _ in range(TRUSTED_AFTER):
        times.note(0.080, 0.080, 0.015)
    learned = times.timing(TIMINGS.read, TAU, AT_FIRST)
    assert (learned.window, learned.inter_byte_timeout) == (TIMINGS.read.window, TIMINGS.read.inter_byte_timeout)


def test_reads_and_writes_and_packets_are_kept_apart() -> None:
    node = Learning()
    for _ in range(TRUSTED_AFTER):
        for command, took in ((hcp2.Read(1), 0.002), (hcp2.Write(1, (1,)), 0.04)):
            node.timings(command, TIMINGS, AT_FIRST)
            node.note(command, False, took, took, 0.0, TAU)
        node.note(hcp2.Read(1), True, 0.02, 0.02, 0.0, TAU)
    timings = node.timings(hcp2.Read(2), TIMINGS, AT_FIRST)
    assert timings.read.window == pytest.approx(LEAST)
    assert timings.packet.window == pytest.approx(0.032)
    assert node.timings(hcp2.Write(1, (1,)), TIMINGS, AT_FIRST).write.window == TIMINGS.write.window
    assert node.timings(hcp2.Read(2), TIMINGS, NEVER) == TIMINGS


def test_the_pause_that_ends_a_reply_follows_the_baud_rate() -> None:
    node = Learning()
    node.timings(hcp2.Read(1), TIMINGS, AT_FIRST)
    for byte_time in (TAU, 2 * TAU, TAU):
        for _ in range(TRUSTED_AFTER):
            node.note(hcp2.Read(1), False, 0.001, 0.001, 0.0, byte_time)
        pause = node.timings(hcp2.Read(1), TIMINGS, AT_FIRST).read.inter_byte_timeout
        assert pause == pytest.approx(LEAST_SILENCE * byte_time)


def test_what_an_earlier_run_has_learned_is_trusted_after_fewer_replies() -> None:
    node = Learning()
    node.begin_with([LearnedTimes("Read", False, 0.004, 0.004, 0.0, 0.008, True)])
    for _ in range(TRUSTED_AGAIN_AFTER):
        assert node.timings(hcp2.Read(1), TIMINGS, AT_FIRST).read.window == TIMINGS.read.window
        node.note(hcp2.Read(1), False, 0.001, 0.001, 0.0, TAU)
    assert node.timings(hcp2.Read(1), TIMINGS, AT_FIRST).read.window == pytest.approx(0.008)
