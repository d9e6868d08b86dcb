"""The benchmarks measure what they say: the other end keeps to its table, wrong values count. No figure is tested."""

from __future__ import annotations

import asyncio
import time
from dataclasses import replace

import pytest

from benchmarks import __main__ as command_line
from benchmarks import codecs, modbus_masters
from benchmarks.harness import Claim, Options, Table, Timings, quantile
from benchmarks.late_replies import LATE
from benchmarks.lines import Kind, Lines
from benchmarks.masters import Bare, Master, Ours, Question, Streams
from benchmarks.questions import hcp2_questions, msc_questions, wire_time
from benchmarks.simulation import Simulation
from benchmarks.trials import ours_in_virtual_time
from benchmarks.watch import Hold, Watch
from busmaster.contract.exchange import Done
from busmaster.contract.profile import LineSettings, Profile
from busmaster.emulator.faults import Faults
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.msc import codec as msc
from busmaster.testing.virtual_time import run_in_virtual_time

QUICK = Options(quick=True)


@pytest.mark.parametrize("kind", list(Kind))
def test_ours_and_the_bare_loop_get_the_values_that_the_other_end_has(kind: Kind) -> None:
    questions = hcp2_questions()

    async def run() -> list[int]:
        masters: list[Master] = [Ours(hcp2.PROFILE, questions), Bare(questions), Streams(questions)]
        with Lines(len(masters), {ask.request: ask.reply for ask in questions}, kind=kind) as lines:
            wrong = []
            for master, port in zip(masters, lines.ports, strict=True):
                await master.open(port)
                wrong.append(await master.run(len(questions)))
                await master.close()
        return wrong

    assert asyncio.run(run()) == [0, 0, 0]


@pytest.mark.parametrize(("profile", "questions"), [(hcp2.PROFILE, hcp2_questions()), (msc.PROFILE, msc_questions())])
def test_the_table_of_the_other_end_is_what_our_reader_takes_for_the_value(
    profile: Profile, questions: list[Question]
) -> None:
    for ask in questions:
        exchange = ask.command.open(ask.address, profile.timings)
        step = exchange.feed(b"".join(ask.reply))
        while not isinstance(step, Done):
            step = exchange.feed(b"")
        assert (step.value, step.send, step.rest) == (ask.value, ask.closing, b"")


def test_a_hold_of_the_loop_is_seen_and_what_the_collector_took_is_told_apart() -> None:
    watch = Watch()

    async def run() -> tuple[Hold, Hold]:
        await asyncio.sleep(0)
        watch.take()
        until = time.thread_time() + 0.005
        while time.thread_time() < until:
            pass
        await asyncio.sleep(0)
        held = watch.take()
        watch.collects("start", {})
        until = time.thread_time() + 0.005
        while time.thread_time() < until:
            pass
        watch.collects("stop", {})
        await asyncio.sleep(0)
        return held, watch.take()

    with asyncio.Runner(loop_factory=lambda: asyncio.SelectorEventLoop(watch)) as runner:
        held, collected = runner.run(run())
    assert held.own >= 5.0
    assert collected.cpu >= 5.0
    assert collected.own <= collected.cpu - 5.0


def test_a_wrong_value_is_counted() -> None:
    questions = [replace(ask, value=ask.value + 1) for ask in hcp2_questions()]

    async def run() -> int:
        master = Ours(hcp2.PROFILE, questions)
        with Lines(1, {ask.request: ask.reply for ask in questions}) as lines:
            await master.open(lines.ports[0])
            wrong = await master.run(len(questions))
            await master.close()
        return wrong

    assert asyncio.run(run()) == len(questions)


def test_the_other_end_of_a_paced_msc_line_takes_the_closing_ack_off_and_reports_dead_times() -> None:
    questions = msc_questions()

    async def run() -> tuple[int, list[list[float]]]:
        master = Bare(questions)
        settings = LineSettings(115200)
        with Lines(
            1, {ask.request: ask.reply for ask in questions}, settings=settings, swallow=questions[0].closing
        ) as lines:
            await master.open(lines.ports[0])
            lines.dead_times()
            wrong = await master.run(5)
            dead = lines.dead_times()
            await master.close()
        return wrong, dead

    wrong, dead = asyncio.run(run())
    assert wrong == 0
    assert len(dead[0]) == 4  # none before the first since the last report


def test_the_limit_of_the_wire_is_bits_and_reply_time() -> None:
    ask = hcp2_questions()[0]
    assert wire_time(ask, LineSettings(9600), 0.002) == pytest.approx((8 + 13) * 10 / 9600 + 0.002, abs=2 * 10 / 9600)


def test_late_replies_and_cancelled_callers_give_no_wrong_value_in_virtual_time() -> None:
    late = run_in_virtual_time(ours_in_virtual_time(300, LATE, None))
    assert (late["wrong"], late["right"] + late["failed"] >= 300) == (0, True)
    cancelled = run_in_virtual_time(ours_in_virtual_time(300, {"low": 0.001, "high": 0.008}, 0.05))
    assert cancelled["wrong"] == 0
    assert cancelled["cancelled"] > 30


def test_a_simulation_counts_each_transaction_once() -> None:
    simulation = Simulation(Faults(lost=0.02, flip=0.02), 5.0)
    simulation.run()
    assert simulation.wrong == 0
    assert simulation.done == simulation.right + simulation.failed >= 200


def test_every_protocol_has_a_row_among_the_codecs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(codecs, "_best", lambda call, number: (call() and 1.0) or 1.0)
    table = codecs.run(QUICK).tables[0]
    assert {str(row[0]).split()[0] for row in table.rows} == {"hcp", "hcp2", "msc", "mentor", "dc104", "modbus"}


def test_peers_that_are_not_installed_are_named_and_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modbus_masters, "installed", lambda _: False)
    assert [maker().name for maker in modbus_masters.masters(QUICK)] == ["busmaster"]
    assert "not installed: pymodbus, minimalmodbus, tmodbus, anymodbus" in modbus_masters.notes(QUICK)[-1]


def test_a_ratio_is_the_median_of_the_ratios_of_neighbouring_rounds() -> None:
    assert Timings([1.0, 2.0, 30.0]).ratio(Timings([1.0, 1.0, 10.0])) == 2.0
    assert Timings([], [1.0, 2.0, 30.0]).cpu_ratio(Timings([], [1.0, 1.0, 10.0])) == 2.0


def test_which_rounds_were_calm_is_for_the_other_to_say() -> None:
    ours, bare = Timings([], [9.0, 5.0, 1.0, 7.0, 2.0]), Timings([], [3.0, 1.0, 9.0, 2.0, 8.0])
    assert ours.cpu_in_calm(bare) == 6.0


def test_a_claim_says_whether_it_is_met() -> None:
    assert str(Claim("rate", 97.0, 95, at_most=False)) == "met: rate: 97 (wanted >= 95)"
    assert str(Claim("ratio", 1.4, 1.3)) == "NOT MET: ratio: 1.4 (wanted <= 1.3)"


def test_a_table_is_aligned_and_shows_a_dash_where_there_is_nothing() -> None:
    table = Table("T", ("master", "us"), notes=["a note"])
    table.row("ours", 1234.5)
    table.row("theirs", None)
    table.row("nobody's", quantile([], 0.5))
    assert table.text().splitlines() == [
        "T",
        "  master      us",
        "  --------  ----",
        "  ours      1234",
        "  theirs       -",
        "  nobody's     -",
        "  a note",
    ]


def test_a_scenario_that_does_not_exist_is_refused(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["benchmarks", "turnarond"])
    with pytest.raises(SystemExit):
        command_line.main()
    assert "no such scenario: turnarond" in capsys.readouterr().err
