"""Does this schedule fit this line? What the planner says, calculated by hand where that can be done."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import inf
from typing import Any

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings

from busmaster import planning
from busmaster.arbiter.backlog import SHARE
from busmaster.arbiter.choice import MOST_BEFORE
from busmaster.arbiter.transaction import Priority
from busmaster.contract.exchange import Command
from busmaster.contract.profile import LineSettings
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.errors import InvalidCommand
from busmaster.planning import Bounds, Losses, Plan, PlannedGroup, PlannedNode, Sharing, bounds, longest_hold, plan
from busmaster.protocols.dc104 import codec as dc104
from busmaster.protocols.hcp import codec as hcp
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.msc import codec as msc

LINE = LineSettings(57600)
TAU = LINE.byte_time
NODE = PlannedNode(hcp2.PROFILE, 1, reply_time=0.002)
EXCHANGE = (8 + 12) * TAU + 0.002
"""One HCP2 read: 8 bytes there, 12 typical ones back."""
URGENT, COMMAND, POLL, BACKGROUND = Priority


def group(name: str, period: float, count: int, *, node: PlannedNode = NODE, **options: Any) -> PlannedGroup:
    return PlannedGroup(name, period, [(node, hcp2.Read(element + 1)) for element in range(count)], **options)


def planned(*groups: PlannedGroup, **options: Any) -> Plan:
    return plan(groups, line=LINE, **options)


# how busy


def test_utilisation_is_line_time_over_period_summed_over_the_groups() -> None:
    prediction = planned(group("fast", 0.1, 3), group("slow", 1.0, 20))
    assert prediction.utilisation == pytest.approx(3 * EXCHANGE / 0.1 + 20 * EXCHANGE / 1.0)
    assert [g.utilisation for g in prediction.groups] == pytest.approx([30 * EXCHANGE, 20 * EXCHANGE])
    assert prediction.fits
    assert prediction.advice == ()


def test_an_unknown_reply_time_is_taken_as_half_the_late_after_one() -> None:
    """HCP2: "normally within 50ms"."""
    unknown = planned(group("g", 1.0, 1, node=PlannedNode(hcp2.PROFILE, 1)))
    assert unknown.groups[0].line_time == pytest.approx(EXCHANGE - 0.002 + 0.025)


def test_two_points_with_one_command_behind_them_cost_one_exchange() -> None:
    twice = PlannedGroup("g", 1.0, [(NODE, hcp2.Read(1)), (NODE, hcp2.Read(1))])
    assert planned(twice).groups[0].exchanges == 1


def test_an_empty_line_and_an_empty_group_ask_for_nothing() -> None:
    assert planned().utilisation == 0
    assert planned().fits
    idle = planned(group("idle", 1.0, 0)).groups[0]
    assert (idle.cycle, idle.longest_cycle, idle.missed, idle.fitting_period) == (0.0, 0.0, 0.0, None)


def test_a_period_that_cannot_be_is_refused() -> None:
    with pytest.raises(InvalidCommand):
        planned(group("g", 0.0, 1))


# how late


def test_a_lone_group_takes_its_line_time_and_misses_nothing() -> None:
    lone = planned(group("lone", 0.1, 10)).groups[0]
    assert lone.cycle == pytest.approx(10 * EXCHANGE)
    assert lone.longest_cycle == pytest.approx(10 * EXCHANGE)
    assert (lone.missed, lone.achieved) == (0.0, 0.1)


def test_groups_that_are_due_together_wait_for_each_other() -> None:
    quick, slow = group("a", 0.1, 5, phase=0.0), group("b", 0.2, 5, phase=0.0)
    for groups in ((quick, slow), (slow, quick)):
        longest = {one.name: one.longest_cycle for one in planned(*groups).groups}
        assert longest == {"a": pytest.approx(5 * EXCHANGE), "b": pytest.approx(10 * EXCHANGE)}


def test_the_group_that_misses_is_named_with_what_it_will_achieve() -> None:
    """22 ms of work every 20 ms: each second cycle cannot start."""
    count = round(0.022 / EXCHANGE)
    prediction = planned(group("greedy", 0.020, count), group("modest", 10.0, 1))
    greedy = prediction.groups[0]
    assert not prediction.fits
    assert greedy.missed == pytest.approx(0.5, abs=0.02)
    assert greedy.achieved == pytest.approx(0.040, abs=0.002)
    assert any("'greedy' will miss 50% of its cycles" in line for line in prediction.advice)
    assert not any("'modest' will miss" in line for line in prediction.advice)


def test_a_group_in_background_gets_what_the_others_leave_and_an_eighth() -> None:
    prediction = planned(
        group("main", 0.05, round(0.045 / EXCHANGE)),
        group("more", 0.05, round(0.045 / EXCHANGE)),
        group("history", 1.0, 10, priority=BACKGROUND),
    )
    history = prediction.groups[2]
    assert history.missed == 0.0
    assert history.cycle == pytest.approx(8 * 10 * EXCHANGE, rel=0.05)


def test_a_group_without_time_to_spare_is_named_although_it_fits() -> None:
    tight = planned(group("tight", 11 * EXCHANGE, 10, phase=0.0), group("easy", 5.0, 1))
    assert tight.fits
    assert any("'tight' has no time to spare" in line for line in tight.advice)
    assert not any("'easy'" in line and "spare" in line for line in tight.advice)
    assert planned(group("easy", 5.0, 1), group("tight", 11 * EXCHANGE, 10, phase=0.0)).advice == tight.advice


def test_a_cycle_that_never_ends_is_endless() -> None:
    [endless, empty] = planned(group("a", 0.01, 200), PlannedGroup("empty", 0.01, [])).groups
    assert endless.line_time > 10 * endless.period
    assert (endless.cycle, endless.longest_cycle) == (inf, inf)
    assert (empty.cycle, empty.longest_cycle) == (0, 0)


def test_a_group_in_background_that_is_alone_has_the_whole_line() -> None:
    [alone] = planned(group("history", 1.0, 10, priority=BACKGROUND)).groups
    assert (alone.cycle, alone.longest_cycle, alone.missed) == pytest.approx((10 * EXCHANGE, 10 * EXCHANGE, 0))


def test_a_schedule_does_not_fit_if_any_of_its_groups_misses_cycles() -> None:
    calm, hurried = group("calm", 10.0, 1), group("hurried", 0.020, round(0.022 / EXCHANGE))
    for groups in ((calm, hurried), (hurried, calm)):
        prediction = planned(*groups)
        assert [bool(one.missed) for one in prediction.groups] == [one is hurried for one in groups]
        assert not prediction.fits
        assert not replace(prediction, utilisation=1.0).fits
        assert not replace(prediction, groups=prediction.groups[:0]).fits


def test_a_group_without_time_to_spare_is_named_although_the_line_is_not_busy() -> None:
    """An exchange of another group that starts just before it is due takes nearly all of its spare time."""
    period = 2.1 * EXCHANGE
    quick, seldom = group("quick", period, 1, phase=0.0), group("seldom", 10.0, 1, phase=3 * period - 0.05 * EXCHANGE)
    for groups in ((quick, seldom), (seldom, quick)):
        prediction = planned(*groups)
        assert prediction.utilisation < 0.5
        assert prediction.fits
        [_, spare] = prediction.advice
        assert spare.startswith("group 'quick' has no time to spare: a cycle takes up to ")


# what would fit


def test_the_advice_names_each_group_and_each_way_out() -> None:
    node = PlannedNode(mentor.PROFILE, 4, reply_time=0.01)
    line = replace(mentor.PROFILE.line, baudrate=4800)
    groups = [
        PlannedGroup("drive", 0.4, [(node, mentor.Read(1, number)) for number in range(1, 9)]),
        PlannedGroup("more", 0.4, [(node, mentor.Read(2, number)) for number in range(1, 9)]),
        PlannedGroup("seldom", 100.0, [(node, mentor.Read(4, 1))]),
    ]
    prediction = plan(groups, line=line, could_merge=[mentor.merge_runs])
    drive, more, _ = prediction.groups
    longer = [
        f"it would fit with a period of {each.fitting_period:g} s for group" if each.fitting_period else ""
        for each in (drive, more)
    ]
    saved = f"merged reads would take {drive.could_save / 0.4:.0%} of the line off group"
    spare = [
        f"group {each.name!r} will miss {each.missed:.0%} of its cycles: one every {each.achieved:.3g} s in place of "
        "0.4 s"
        for each in (drive, more)
    ]
    assert prediction.advice == (
        f"the schedule needs {prediction.utilisation:.0%} of the line; up to 90% is comfortable",
        spare[0],
        *([f"{longer[0]} 'drive'"] if longer[0] else []),
        f"{saved} 'drive', where they are safe",
        spare[1],
        *([f"{longer[1]} 'more'"] if longer[1] else []),
        f"{saved} 'more', where they are safe",
        f"it would fit with all periods {prediction.utilisation / 0.9:.2f} times as long",
        f"it would fit at {prediction.fitting_baudrate} baud",
    )
    assert drive.missed
    assert more.missed
    assert drive.could_save == more.could_save > 0
    without = replace(prediction, fitting_baudrate=None).advice
    assert without == prediction.advice[:-1]


def test_a_baud_rate_must_be_enough_for_all_groups_and_possible_for_all_nodes() -> None:
    slow = LineSettings(9600)
    one, other = group("a", 0.1, 10), group("b", 0.1, 10)
    rates = [plan(groups, line=slow).fitting_baudrate for groups in ([one], [one, other], [other, one])]
    assert rates[0] is not None
    assert rates[1] == rates[2]
    assert rates[1] is not None
    assert rates[0] < rates[1]
    fixed = PlannedNode(replace(hcp2.PROFILE, fixed_rate=True), 2, reply_time=0.002)
    assert plan([one, group("b", 0.1, 1, node=fixed)], line=slow).fitting_baudrate is None
    mixed = replace(one, reads=[*one.reads, (fixed, hcp2.Read(1))])
    assert plan([mixed], line=slow).fitting_baudrate is None


def fitting(prediction: Plan, groups: Sequence[PlannedGroup], line: LineSettings = LINE) -> float:
    return plan(groups, line=line).utilisation


def test_a_longer_period_that_fits_is_offered_and_does() -> None:
    groups = [group("a", 0.05, 8), group("b", 0.5, 30)]
    prediction = planned(*groups)
    longer = prediction.groups[0].fitting_period
    assert prediction.utilisation > 1
    assert longer is not None
    assert fitting(prediction, [replace(groups[0], period=longer), groups[1]]) <= 0.9
    assert fitting(prediction, [replace(groups[0], period=0.93 * longer), groups[1]]) > 0.9


def test_no_period_is_offered_for_a_group_that_cannot_help() -> None:
    prediction = planned(group("a", 0.02, 8), group("b", 10.0, 1))
    assert prediction.groups[1].fitting_period is None


def test_the_lowest_baud_rate_that_fits_is_offered() -> None:
    slow = LineSettings(9600)
    groups = [group("a", 0.1, 10)]
    rate = plan(groups, line=slow).fitting_baudrate
    assert rate is not None
    assert fitting(plan(groups, line=slow), groups, LineSettings(rate)) <= 0.9
    lower = planning.BAUDRATES[planning.BAUDRATES.index(rate) - 1]
    assert lower == 9600 or fitting(plan(groups, line=slow), groups, LineSettings(lower)) > 0.9


def test_no_baud_rate_is_offered_where_the_replies_alone_take_too_long() -> None:
    assert planned(group("a", 0.02, 8, node=PlannedNode(hcp2.PROFILE, 1, reply_time=0.01))).fitting_baudrate is None


def test_no_baud_rate_is_offered_to_devices_that_have_but_one() -> None:
    node = PlannedNode(msc.PROFILE, 1, reply_time=0.002)
    groups = [PlannedGroup("a", 0.1, [(node, msc.DataRead(address)) for address in range(4)])]
    prediction = plan(groups, line=msc.PROFILE.line)
    assert prediction.utilisation > 1
    assert prediction.fitting_baudrate is None
    selectable = PlannedNode(replace(msc.PROFILE, fixed_rate=False), 1, reply_time=0.002)
    groups = [replace(groups[0], reads=[(selectable, command) for _, command in groups[0].reads])]
    assert plan(groups, line=msc.PROFILE.line).fitting_baudrate is not None


def test_merged_reads_are_told_with_what_they_save() -> None:
    node = PlannedNode(mentor.PROFILE, 4, reply_time=0.01)
    reads = [(node, mentor.Read(1, number)) for number in range(1, 9)]
    line = mentor.PROFILE.line
    single = PlannedGroup("drive", 1.0, reads)
    merged = plan([replace(single, merge=[mentor.merge_runs])], line=line).groups[0]
    alone = plan([single], line=line, could_merge=[mentor.merge_runs]).groups[0]
    assert [(m.node, m.command, m.serves) for m in merged.merged] == [("node 4", "read 01.01 to 01.08", 8)]
    assert merged.exchanges == 1
    assert alone.merged == ()
    assert alone.could_save == pytest.approx(merged.merged[0].saved) == pytest.approx(7 * 9 * line.byte_time)
    assert merged.line_time == pytest.approx(alone.line_time - alone.could_save)
    assert merged.could_save == 0.0


def test_merges_of_the_profile_need_no_asking() -> None:
    profile = replace(msc.PROFILE, merge=msc.Merging(address_step=4))
    node = PlannedNode(profile, 1, reply_time=0.005)
    reads = [(node, msc.DataRead(2000 + 4 * n)) for n in range(8)]
    assert plan([PlannedGroup("press", 1.0, reads)], line=msc.PROFILE.line).groups[0].exchanges == 1


# the worst case


def test_r9_the_longest_hold_of_a_read() -> None:
    """8 bytes; 150 ms maximum reply delay; a reply of at most 25 bytes that trickles in, 20 ms a byte; 20 ms of
    silence. Each of these times is to a start bit, and the byte is received a byte time later."""
    hold = longest_hold(hcp2.Read(1).open(1, hcp2.PROFILE.timings), TAU)
    assert hold == pytest.approx(8 * TAU + 0.150 + TAU + 25 * (0.020 + TAU) + 0.020 + TAU)


def test_r9_a_trickle_ends_where_the_line_counts_as_noisy() -> None:
    tau = msc.PROFILE.line.byte_time
    hold = longest_hold(msc.DataWrite(2000, 1).open(1, msc.PROFILE.timings), tau)
    step = 1.0 + tau + 248 * tau + 0.1
    assert hold == pytest.approx(21 * tau + step + (1.0 + 0.1 + tau) + 0.1 + tau)


def test_r9_each_step_can_last_its_max_reply_delay() -> None:
    """Late replies are delivered, and the next step follows."""
    tau = mentor.PROFILE.line.byte_time
    one, three = (longest_hold(mentor.ReadRun(1, 1, n).open(1, mentor.PROFILE.timings), tau) for n in (1, 3))
    size = 1 + 4 + 5 + 1 + 1
    step = 0.300 + tau + 0.050 + size * tau
    assert three == pytest.approx(one + 2 * (step + tau))


def test_r9_the_line_is_held_until_a_driver_releases_it_and_the_closing_bytes_have_left() -> None:
    read = hcp2.Read(1)
    slow = Timings.uniform(replace(hcp2.PROFILE.timings.read, driver_release_time=0.4))
    assert longest_hold(read.open(1, slow), TAU) == pytest.approx(longest_hold(NODE.open(read), TAU) + 0.4)
    closed, open_ = (msc.DataRead(2000).open(1, msc.PROFILE.timings) for _ in range(2))
    open_.closing = 0
    assert closed.closing == 1
    assert longest_hold(closed, TAU) == pytest.approx(longest_hold(open_, TAU) + TAU)


def test_r9_the_receive_latency_of_an_adapter_counts_once_a_step_and_in_every_silence() -> None:
    read = hcp2.Read(1).open(1, hcp2.PROFILE.timings)
    assert longest_hold(read, TAU, 0.016) == pytest.approx(longest_hold(read, TAU) + (1 + 25 + 1) * 0.016)


def test_r9_an_exchange_with_a_limit_may_be_repeated_until_then_but_not_while_urgent_waits() -> None:
    node = PlannedNode(msc.PROFILE, 1)
    bound = bounds([(node, msc.DataRead(2000))], msc.PROFILE.line.byte_time)
    assert bound.hold == pytest.approx(bound.urgent_hold + 2.0)


def test_r9_every_nodes_probe_counts_but_a_broadcast_has_none() -> None:
    tau = mentor.PROFILE.line.byte_time
    broadcast = (PlannedNode(mentor.PROFILE, 0), mentor.Write(1, 17, 0))
    alone = bounds([broadcast], tau)
    drive = (PlannedNode(mentor.PROFILE, 1), mentor.Write(1, 17, 0))
    assert bounds([broadcast, drive], tau).hold > alone.hold
    long = replace(mentor.PROFILE, probe=mentor.ReadRun(1, 1, 8))
    for address, longest in ((0, mentor.Write(1, 17, 0)), (1, long.probe)):
        node = PlannedNode(long, address)
        bound = bounds([(node, mentor.Write(1, 17, 0))], tau)
        assert bound.hold == bound.urgent_hold == longest_hold(node.open(longest), tau)


def test_r9_the_waits_of_the_four_classes() -> None:
    """Before each, three others may go (R15)."""
    bound = Bounds(hold=1.0, urgent_hold=0.5, polls=10, background=0)
    assert [bound.wait(URGENT, ahead=n) for n in (0, 1, 5)] == [0.5, 0.5 * 5, 0.5 * 21]
    assert [bound.wait(COMMAND, ahead=n) for n in (0, 6, 7, 13)] == [
        1 + 4 * turns + 3 for turns in (0 + 1, 6 + 1, 7 + 2, 13 + 2)
    ]
    assert bound.wait(POLL, patience=0.25) == 0.25 + 4 * 8 * 10
    both = replace(bound, background=3)
    assert both.wait(POLL, patience=0.25) == 0.25 + 4 * 16 * 10
    assert both.wait(BACKGROUND, patience=2.0) == 2.0 + 4 * 16 * 3


def test_the_plan_tells_the_waits_of_every_class_and_of_every_group() -> None:
    prediction = planned(group("a", 0.5, 4), group("b", 20.0, 2))
    hold = longest_hold(hcp2.Read(1).open(1, hcp2.PROFILE.timings), TAU)
    assert prediction.typical_wait == pytest.approx(EXCHANGE)
    assert prediction.dead_wait == pytest.approx(8 * TAU + 0.150)
    assert prediction.worst_waits[URGENT] == pytest.approx(hold)
    assert prediction.worst_waits[COMMAND] == pytest.approx((1 + 4 + 3) * hold)
    assert [g.worst_wait for g in prediction.groups] == pytest.approx([0.5 + 4 * 8 * 6 * hold, 10.0 + 4 * 8 * 6 * hold])
    assert prediction.groups[0].worst_cycle == pytest.approx(prediction.groups[0].worst_wait + hold)


def test_r9_the_exchanges_of_all_groups_count_in_the_waits() -> None:
    slow = PlannedNode(hcp2.PROFILE, 9, Timings.uniform(ReplyTiming(0.1, 0.5, 0.7, 0.02)))
    reads = {
        "a": [(NODE, hcp2.Read(1)), (NODE, hcp2.Read(2))],
        "b": [(slow, hcp2.Read(1))],
        "c": [(NODE, hcp2.Read(3))],
    }
    classes = {"a": POLL, "b": POLL, "c": BACKGROUND, "d": BACKGROUND}
    reads["d"] = [(NODE, hcp2.Read(4)), (NODE, hcp2.Read(5))]
    groups = [PlannedGroup(name, 10.0, each, priority=classes[name]) for name, each in reads.items()]
    bound = bounds([read for each in reads.values() for read in each], TAU, polls=3, background=3)
    waits = {priority: pytest.approx(bound.wait(priority)) for priority in Priority}
    assert planned(*groups).worst_waits == planned(*reversed(groups)).worst_waits == waits


def test_the_usual_waits_are_those_of_the_slowest_exchange_of_all_groups() -> None:
    slow = PlannedNode(hcp2.PROFILE, 9, Timings.uniform(ReplyTiming(0.1, 0.5, 0.7, 0.02)), reply_time=0.05)
    groups = [group("a", 1.0, 2), group("b", 1.0, 1, node=slow)]
    for ordered in (groups, groups[::-1]):
        prediction = planned(*ordered, receive_latency=0.016)
        assert prediction.typical_wait == pytest.approx(EXCHANGE - 0.002 + 0.05)
        assert prediction.dead_wait == pytest.approx(8 * TAU + 0.7 + 0.016)


def test_r9_other_programs_and_their_sequences_lengthen_the_waits() -> None:
    alone = planned(group("a", 0.5, 4))
    for sharing, clients, held in ((Sharing(2, 0.0), 2, 0.0), (Sharing(0, 0.7), 0, 0.7), (Sharing(2, 0.7), 2, 0.7)):
        waits = planned(group("a", 0.5, 4), sharing=sharing).worst_waits
        bound = bounds([(NODE, hcp2.Read(1))], TAU, polls=4)
        expected = replace(bound, clients=clients, held=held)
        assert waits == {priority: pytest.approx(expected.wait(priority)) for priority in Priority}
        assert waits[COMMAND] > alone.worst_waits[COMMAND]
    assert planned(group("a", 0.5, 4), sharing=Sharing()).worst_waits == alone.worst_waits


def test_r9_the_receive_latency_of_an_adapter_counts_in_every_wait() -> None:
    read = hcp2.Read(1)
    slow = planned(group("a", 0.5, 4), receive_latency=0.016)
    bound = bounds([(NODE, read)], TAU, 0.016, polls=4)
    assert bound.urgent_hold == longest_hold(NODE.open(read), TAU, 0.016)
    assert slow.worst_waits == {priority: pytest.approx(bound.wait(priority)) for priority in Priority}


def test_r9_the_bounds_of_a_shared_line_are_those_of_its_plan() -> None:
    bound = bounds([(NODE, hcp2.Read(1))], TAU, polls=4, sharing=Sharing(2, 0.7))
    assert (bound.clients, bound.held) == (2, 0.7)
    shared = planned(group("a", 0.5, 4), sharing=Sharing(2, 0.7))
    assert shared.worst_waits == {priority: pytest.approx(bound.wait(priority)) for priority in Priority}


def test_r9_each_other_program_goes_before_a_request_twice() -> None:
    """With two others, each request waits for five in place of one."""
    shared = Bounds(hold=1.0, urgent_hold=0.5, polls=10, clients=2)
    assert [shared.wait(URGENT, ahead=n) for n in (0, 1)] == [0.5 * (1 + 4 * 4), 0.5 * (1 + 4 * 9)]
    assert [shared.wait(COMMAND, ahead=n) for n in (0, 1)] == [1 + 4 * (4 + 1) + 3, 1 + 4 * (9 + 2) + 3]
    assert shared.wait(POLL, patience=0.25) == 0.25 + 4 * 8 * 50
    held = replace(shared, held=0.5, background=3)
    assert held.wait(URGENT) == shared.wait(URGENT)
    assert held.wait(COMMAND) == 1.5 * (1 + 4 * (4 + 5) + 3)
    assert held.wait(POLL, patience=0.25) == 0.25 + 4 * 16 * 50 * 1.5
    assert held.wait(BACKGROUND, patience=2.0) == 2.0 + 4 * 16 * 15 * 1.5


def test_r9_a_poll_has_a_bound_also_where_none_is_counted() -> None:
    assert Bounds(hold=1.0, urgent_hold=1.0).wait(POLL) == 1.0 + 4 * 8
    assert Bounds(hold=1.0, urgent_hold=1.0).wait(BACKGROUND, patience=0.0) == 4 * 16


def test_r9_while_the_line_is_held_each_command_may_wait_for_one_of_a_lower_class() -> None:
    free, held = Bounds(hold=1.0, urgent_hold=1.0), Bounds(hold=0.5, urgent_hold=1.0, held=0.5)
    each, ahead = 1 + MOST_BEFORE, 2 * SHARE - 1
    assert free.wait(COMMAND, ahead=ahead) == 1 + each * (ahead + 2) + MOST_BEFORE
    assert held.wait(COMMAND, ahead=ahead) == 1 + each * (ahead + 2 * SHARE) + MOST_BEFORE


# what lost frames cost


def test_what_lost_frames_cost_and_learning_would_spare_is_calculated() -> None:
    """A line that is full: what it keeps of its rate is what the benchmark `lossy_line` measures, 58 and 94 to 95 %."""
    full = planned(group("g", 32 * EXCHANGE, 32))
    assert full.utilisation == pytest.approx(1.0)
    assert 1 / full.losses.documented == pytest.approx(0.58, abs=0.1)
    assert 1 / full.losses.learned == pytest.approx(0.95, abs=0.015)
    assert full.losses.windows == pytest.approx((0.005, 0.005))


def test_learning_spares_nothing_where_replies_take_as_long_as_the_window() -> None:
    slow = PlannedNode(hcp2.PROFILE, 2, reply_time=0.09)
    losses = planned(group("g", 10.0, 2, node=slow)).losses
    assert losses.learned == pytest.approx(losses.documented, rel=0.01)
    assert losses.windows == (hcp2.PROFILE.timings.read.window,) * 2
    assert planned().losses == Losses(0.01, 0.0, 0.0, (0.0, 0.0))


def test_lost_frames_of_each_group_count_by_its_period_and_windows_are_those_of_all_nodes() -> None:
    slow = PlannedNode(hcp2.PROFILE, 2, reply_time=0.09)
    groups = [group("a", 1.0, 2), group("b", 2.0, 3, node=slow), PlannedGroup("empty", 1.0, [])]
    each = [planned(one).losses for one in groups]
    losses = planned(*groups).losses
    assert losses.documented == pytest.approx(sum(one.documented for one in each))
    assert losses.learned == pytest.approx(sum(one.learned for one in each))
    assert each[0].windows[0] < each[1].windows[1]
    assert losses.windows == (each[0].windows[0], each[1].windows[1])
    one_by_one = planned(PlannedGroup("a", 1.0, [(slow, hcp2.Read(1)), (NODE, hcp2.Read(1))])).losses
    assert one_by_one.windows == losses.windows


def test_what_else_may_be_asked_counts_in_the_worst_case() -> None:
    slow = Timings.uniform(ReplyTiming(0.1, 1.0, 2.0, 0.02))
    others = [(PlannedNode(hcp2.PROFILE, 9, slow), hcp2.Write(1, (1.0,)))]
    assert planned(group("a", 0.5, 4), others=others).worst_waits[COMMAND] > 4.0


COMMANDS: list[tuple[PlannedNode, Command[Any]]] = [
    (PlannedNode(hcp.PROFILE, 1), hcp.Read(1)),
    (PlannedNode(hcp2.PROFILE, 1), hcp2.Write(1, (1.5, 2.5))),
    (PlannedNode(mentor.PROFILE, 1), mentor.ReadRun(1, 1, 8)),
    (PlannedNode(msc.PROFILE, 1), msc.BlockRead(2000)),
    (PlannedNode(dc104.PROFILE, dc104.PROFILE.addresses[0]), dc104.PROFILE.probe),
]


@given(st.lists(st.tuples(st.sampled_from(COMMANDS), st.floats(0.05, 30.0)), max_size=6))
@settings(max_examples=40)
def test_any_plan_adds_up(wanted: list[tuple[tuple[PlannedNode, Command[Any]], float]]) -> None:
    groups = [PlannedGroup(str(n), period, [read]) for n, (read, period) in enumerate(wanted)]
    prediction = plan(groups, line=LineSettings(9600))
    assert prediction.utilisation == pytest.approx(sum(g.line_time / g.period for g in prediction.groups))
    assert prediction.fits or prediction.advice
    for one in prediction.groups:
        assert one.line_time <= one.cycle <= one.longest_cycle or one.cycle == pytest.approx(one.line_time)
        assert one.achieved >= one.period
        assert one.worst_wait > one.line_time


def test_a_line_that_is_nearly_full_gets_the_advice_of_one_that_is_too_full() -> None:
    """Between 90 and 100 % of the line, no cycle is missed, but nothing is left for commands and retries."""
    groups = [group("a", 32 * EXCHANGE / 0.95, 32)]
    prediction = planned(*groups)
    assert prediction.utilisation == pytest.approx(0.95)
    assert prediction.fitting_baudrate == 115200
    assert prediction.groups[0].fitting_period is not None
    assert prediction.advice[-2:] == ("it would fit with all periods 1.06 times as long", "it would fit at 115200 baud")


def test_a_period_that_is_offered_has_two_digits_and_is_not_longer_than_necessary() -> None:
    for hundredths in range(11, 100):
        period = hundredths / 100
        node = PlannedNode(hcp2.PROFILE, 1, reply_time=0.9 * period - 20 * TAU)
        [one] = planned(group("a", 0.05, 1, node=node)).groups
        assert one.fitting_period == period


def test_r9_the_probe_of_each_node_counts_with_its_own_timings() -> None:
    slow = PlannedNode(hcp2.PROFILE, 9, Timings.uniform(ReplyTiming(0.1, 0.5, 0.7, 0.02)))
    quick_write = hcp2.Write(1, (1.0,))
    for nodes in ((NODE, slow), (slow, NODE)):
        bound = bounds([(node, quick_write) for node in nodes], TAU)
        assert bound.hold == longest_hold(slow.open(slow.profile.probe), TAU)


def test_a_node_that_does_not_reply_keeps_the_line_until_its_driver_would_have_released_it() -> None:
    times = replace(hcp2.PROFILE.timings.read, driver_release_time=0.4)
    node = PlannedNode(hcp2.PROFILE, 1, Timings.uniform(times))
    assert planned(group("a", 1.0, 1, node=node)).dead_wait == pytest.approx(8 * TAU + 0.4)


def test_the_values_of_a_group_are_its_points_however_they_are_read() -> None:
    twice = PlannedGroup("g", 1.0, [(NODE, hcp2.Read(1)), (NODE, hcp2.Read(1)), (NODE, hcp2.Read(2))])
    [one] = planned(twice).groups
    assert (one.values, one.exchanges) == (3, 2)
