"""A fixed set of hunts for wrong values; `python -m tests.verification.campaigns` goes on from there."""

from __future__ import annotations

import gc
import hashlib
import subprocess
import sys
from pathlib import Path

import pytest

from busmaster.arbiter import learned as learning
from busmaster.arbiter.in_sync import InSync
from busmaster.emulator.line import Talk
from tests.tiers import in_turn_by_default, one_by_default, one_slow
from tests.verification.campaigns.__main__ import main
from tests.verification.campaigns.hunt import Hunt
from tests.verification.campaigns.judge import BrokenRuleError, Totals
from tests.verification.campaigns.kinds import KINDS
from tests.verification.campaigns.ledger import Frame, Ledger
from tests.verification.campaigns.mixes import BEYOND, IN_SYNC, STANDING_LONG, WITHIN

EACH = 700
"""Transactions of one hunt."""
LONG = 150
"""Likewise, of one with standstills of seconds."""
EVERY_PROTOCOL = pytest.mark.parametrize("protocol", one_by_default(KINDS))
OF_THE_HUNT = pytest.mark.parametrize("protocol", one_slow(KINDS, pytest.mark.exhaustive))
"""For tests of the hunt itself, which one protocol shows as well as all."""


def check(totals: Totals, hunt: Hunt) -> None:
    again = f"python -m tests.verification.campaigns --each {EACH} --replay '{hunt.name}'"
    assert not totals.problems, f"{totals.problems[0]}\nits transcript: {again}"


@pytest.mark.parametrize(("protocol", "mix"), in_turn_by_default(KINDS, (mix.name for mix in WITHIN)))
def test_r1_to_r13_inside_the_assumption_nothing_is_wrong_or_lost_and_everything_heals(protocol: str, mix: str) -> None:
    hunt = Hunt(protocol, mix, 1)
    totals = hunt.run(EACH)
    check(totals, hunt)
    assert totals.confused == totals.lost == 0
    assert totals.transactions >= EACH


@OF_THE_HUNT
def test_what_the_faults_do_shows(protocol: str) -> None:
    """Else the hunts would prove nothing."""
    found, late = {}, {}
    for mix in WITHIN:
        hunt = Hunt(protocol, mix.name, 2)
        found[mix.name] = hunt.run(2000 if mix.name == "tails" else 300)  # one fault in a hundred
        late[mix.name] = sum(node.counters.late for node in hunt.nodes)
    calm = found.pop("calm")
    assert calm.bad_attempts == calm.unexpected_bytes == calm.unseen == 0
    del found["bytewise"], found["shared"]  # nothing is wrong on those lines
    quiet = [name for name, totals in found.items() if totals.bad_attempts + totals.unexpected_bytes + late[name] < 10]
    assert quiet == ["refusals"] or not quiet
    assert found["cancelled"].cancelled > found["late"].cancelled


@OF_THE_HUNT
def test_beyond_the_assumption_the_oracle_sees_what_is_wrong(protocol: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(mix: str) -> Totals:
        total = Totals()
        for seed in range(1, 7):
            total.add(Hunt(protocol, mix, seed).run(1000))
        assert not total.problems
        return total

    seen_by_crc = protocol == "modbus"  # two wrong bits always show in a CRC-16 of so short a frame
    assert (wrong("double flips").unseen == 0) is seen_by_crc
    monkeypatch.setattr(InSync, "add_overdue", lambda in_sync, *overdue: None)
    assert wrong("overdue").confused > 0


@pytest.mark.parametrize(("protocol", "mix"), in_turn_by_default(KINDS, (mix.name for mix in IN_SYNC)))
def test_r15_whatever_stands_still_nothing_is_wrong_or_lost_and_everything_heals(protocol: str, mix: str) -> None:
    hunt = Hunt(protocol, mix, 1)
    totals = hunt.run(EACH)
    check(totals, hunt)
    assert totals.wrong == totals.lost == 0
    assert totals.transactions >= EACH


@pytest.mark.parametrize("learned", [False, True])
@pytest.mark.parametrize(("protocol", "mix"), in_turn_by_default(KINDS, (mix.name for mix in STANDING_LONG)))
def test_r15_a_network_that_stands_still_for_6_s_confirms_no_write_and_delivers_no_other_value(
    protocol: str, mix: str, learned: bool
) -> None:
    hunt = Hunt(protocol, mix, 1, learned=learned)
    totals = hunt.run(LONG)
    check(totals, hunt)
    assert totals.wrong == totals.lost == 0
    assert totals.transactions >= LONG


@pytest.mark.slow
@pytest.mark.parametrize("mix", [mix.name for mix in BEYOND])
def test_beyond_the_assumption_too_everything_ends_and_heals(mix: str) -> None:
    for protocol in KINDS:
        hunt = Hunt(protocol, mix, 1)
        check(hunt.run(150), hunt)


def transcript(protocol: str, mix: str, seed: int) -> list[str]:
    lines: list[str] = []
    Hunt(protocol, mix, seed, lines.append).run(200)
    return lines


@EVERY_PROTOCOL
def test_the_same_seed_gives_the_same_transcript_and_another_another(protocol: str) -> None:
    first = transcript(protocol, "everything", 1)
    assert len(first) > 600
    assert transcript(protocol, "everything", 1) == first
    assert transcript(protocol, "everything", 2) != first


@pytest.mark.slow
def test_the_same_seed_gives_the_same_transcript_byte_for_byte_in_any_process() -> None:
    """Whatever the seed of the hashes is: no set and no address of an object may decide anything."""
    command = [sys.executable, "-m", "tests.verification.campaigns", "--each", "200", "--replay", "msc/everything/1"]
    root = Path(__file__).parents[3]
    digests = set()
    for seed in ("0", "1", "2"):
        ran = subprocess.run(command, cwd=root, env={"PYTHONHASHSEED": seed}, capture_output=True, check=True)
        digests.add(hashlib.sha256(ran.stdout).hexdigest())
    here = "".join(f"{line}\n" for line in transcript("msc", "everything", 1))
    assert digests == {hashlib.sha256(here.encode()).hexdigest()}


@pytest.mark.slow
def test_a_reply_to_noise_is_not_a_reply_that_the_line_has_to_wait_for() -> None:
    """Noise looked like a request to a drive that was replying to a true one: no master can expect its second reply."""
    hunt = Hunt("dc104", "noise", 40001, learned=True)
    hunt.run(700)
    assert not hunt.totals.problems


@pytest.mark.slow
def test_nothing_grows_without_bound() -> None:
    """What is remembered is full after some thousand transactions; then twice as many leave no more objects."""

    def objects(transactions: int) -> int:
        hunt = Hunt("hcp2", "everything", 3)
        hunt.run(transactions)
        gc.collect()
        assert not hunt.totals.problems
        return len(gc.get_objects())

    assert objects(12_000) < objects(6000) + 300


def test_the_command_adds_up_and_says_how_to_replay(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Here of a bug that was planted."""
    monkeypatch.setattr("busmaster.arbiter.on_wire.Step.last_begin", lambda step: step.end + step.timing.window)
    arguments = ["campaigns", "--transactions", "100", "--each", "100", "--protocol", "hcp2", "--seed", "3"]
    monkeypatch.setattr(sys, "argv", [*arguments, "--mix", "late", "--mix", "calm"])
    assert main() == 1
    said = capfd.readouterr().out
    assert "python -m tests.verification.campaigns --replay 'hcp2/late/3' --each 100" in said
    assert "R3: a request leaves while a reply is still to come" in said
    assert "1 rules broken" in said
    monkeypatch.setattr(sys, "argv", [*arguments, "--beyond", "--mix", "overdue"])
    main()
    assert "| replies begin after up to three times the maximum reply delay |" in capfd.readouterr().out
    monkeypatch.setattr(sys, "argv", ["campaigns", "--replay", "hcp2/late/3", "--each", "100"])
    assert main() == 1
    *transcript, last = capfd.readouterr().out.splitlines()
    assert "BROKEN: " in last
    assert len(transcript) > 10


@pytest.mark.parametrize(
    ("protocol", "mix"),
    in_turn_by_default(KINDS, ["calm", "lost", "late", "garbled", "everything", "edges", "edges, all"]),
)
def test_r15_with_learned_times_nothing_is_wrong_or_lost_and_everything_heals(
    protocol: str, mix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learning, "TRUSTED_AFTER", 3)
    monkeypatch.setattr(learning, "EPOCH", 10)
    hunt = Hunt(protocol, mix, 1, learned=True)
    totals = hunt.run(EACH)
    check(totals, hunt)
    assert totals.confused == totals.lost == 0
    assert totals.transactions >= EACH


def test_damage_to_a_request_that_takes_no_time_belongs_to_its_own_exchange() -> None:
    """On a line without pacing. Seed 20900 of Mentor II blamed the master for the reply to a request that noise cut."""
    hunt = Hunt("mentor", "everything", 20900)
    totals = hunt.run(150)
    ledger, line = hunt.ledger, hunt.line
    assert totals.confused == 0
    host = Talk(None, 5.0, 5.0, b"\x04", clean=False, chunk=1)
    drive = Talk(hunt.devices[0], 7.0, 7.0, b"\x06", clean=False, chunk=1)
    for talk in (host, drive):
        line._spoiled(talk, "passes as something else")
    assert ledger.damaged(5.0, 5.1)
    assert not ledger.damaged(7.0, 7.1)


def test_an_overdue_reply_that_noise_made_look_like_the_one_asked_for_is_no_fault_of_the_master() -> None:
    """Seed 60200 of EI-Bisynch: it ended the exchange at the moment the device's own reply began."""
    ledger = Ledger(97, 5)
    late = Frame(8.0, 9.0, 11.0)
    ledger._frames.add(late)
    assert not ledger.disguised(10.0, 11.0)
    ledger.spoiled(late.start, late.end)
    assert ledger.disguised(10.0, 11.0)
    assert not ledger.disguised(10.0, 10.5), "it still lasts"
    assert not ledger.disguised(7.0, 11.0), "it replies to this request"


def test_noise_may_have_taken_the_last_byte_of_such_a_reply() -> None:
    """Seed 271165 of EI-Bisynch with learned windows: it ended a byte earlier than what the device said."""
    ledger = Ledger(97, 5)
    ledger._frames.add(Frame(8.0, 9.0, 12.0))
    ledger.spoiled(9.0, 11.0)
    assert ledger.disguised(10.0, 11.0)
    assert not ledger.disguised(10.0, 10.9), "it still lasts"


def test_on_a_line_without_pacing_such_a_reply_takes_no_time() -> None:
    """Seed 271162 of EI-Bisynch with learned windows."""
    ledger = Ledger(97, 5)
    ledger._frames.add(Frame(8.0, 11.0, 11.0))
    assert not ledger.disguised(10.0, 11.0)
    ledger.spoiled(11.0, 11.0)
    assert ledger.disguised(10.0, 11.0)


def test_a_write_of_msc_may_wait_for_minutes() -> None:
    """Seed 271162 of MSC with learned windows: the harness forgot a write that waited while 2048 others were sent."""
    problems: list[str] = []
    ledger = Ledger(2**31 - 1, 5, problem=problems.append)
    ledger.sending(7, 1, (2016,))
    for number in range(8, 4000):
        ledger.sending(number, 1, (2016,))
    ledger.take(1, 2016, 7)
    assert problems == []


def test_damage_that_lasts_longer_than_later_damage_is_found() -> None:
    ledger = Ledger(97, 5)
    ledger.spoiled(1.0, 10.0)
    ledger.spoiled(2.0, 3.0)
    assert ledger.damaged(5.0, 6.0)
    assert not ledger.damaged(10.0, 11.0)


def test_an_overdue_reply_that_noise_changed_blames_nobody() -> None:
    """Seed 92000 of DC104: noise turned the reply to parameter 2 into one of parameter 3, which was requested then."""
    ledger = Ledger(97, 5)
    changed, whole = Frame(8.0, 9.0, 11.0, b"\x02\x02"), Frame(8.5, 11.0, 12.0, b"\x02\x15")
    ledger._frames.add(changed)
    ledger._frames.add(whole)
    assert list(ledger.overdue_replies(10.0, 12.0)) == [whole, changed]
    ledger.spoiled(changed.start, changed.end)
    assert list(ledger.overdue_replies(10.0, 12.0)) == [whole]
    assert list(ledger.overdue_replies(10.0, 11.0)) == [], "it begins later"
    assert list(ledger.overdue_replies(8.0, 12.0)) == [], "they reply to this request"


def test_a_reply_to_a_request_of_one_byte_was_requested() -> None:
    """Seed 91000 of EI-Bisynch: the host's NAK has a node send its parameter again."""
    line = Hunt("ei-bisynch", "wrong", 1).line
    node = line.devices[0]
    line._request = node.routes[0]
    line.ledger.spoiled(4.9, 5.0)
    line.tell(node, 5.1, 5.2, b"\x04")
    line.send(b"\x15", 5.3)
    line.tell(node, 5.4, 5.5, b"\x04")
    with pytest.raises(BrokenRuleError):  # nothing requested a third reply
        line.tell(node, 5.6, 5.7, b"\x04")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("protocol", "mix", "seed"),
    [
        ("dc104", "wrong", 92000),
        ("ei-bisynch", "wrong", 91000),
        pytest.param("ei-bisynch", "wrong", 60200, marks=pytest.mark.exhaustive),
        pytest.param("ei-bisynch", "shared, everything", 93000, marks=pytest.mark.exhaustive),
    ],
)
def test_a_hunt_in_which_noise_makes_such_a_reply_breaks_no_rule(
    protocol: str, mix: str, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learning, "TRUSTED_AFTER", 3)
    monkeypatch.setattr(learning, "EPOCH", 10)
    assert Hunt(protocol, mix, seed, learned=True).run(5000).problems == []
