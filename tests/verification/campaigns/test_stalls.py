"""Some standstills that `python -m tests.verification.campaigns.stalls` sweeps: in each window and maximum reply
delay."""

from __future__ import annotations

from itertools import product

import pytest

from busmaster.arbiter import learned as learning
from busmaster.arbiter.in_sync import InSync
from tests.planted import without_max_reply_delay
from tests.verification.campaigns.kinds import KINDS
from tests.verification.campaigns.stalls import STRUCK, Case, StallSweep, main, transcript

LENGTHS = (0.12, 0.35, 1.13)
"""Seconds: within and beyond the windows and maximum reply delays of most protocols."""
OF_MSC = (0.04, 0.35, 0.76, 1.06, 1.12, 1.18, 1.24, 1.42, 1.48, 1.61)
"""Likewise of MSC, whose replies may begin last: those in which a refusal confirmed a write before it was received."""


THOROUGH = [
    pytest.param(protocol, strict, learned, marks=[] if learned and not strict else [pytest.mark.slow])
    for protocol, strict, learned in product(KINDS, (False, True), (False, True))
]
"""By default each protocol once, with what is used unless it is set otherwise."""


@pytest.fixture(autouse=True)
def restored_learning(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the constants that `be_hasty` sets restored afterwards."""
    for name in ("TRUSTED_AFTER", "TRUSTED_AGAIN_AFTER", "EPOCH"):
        monkeypatch.setattr(learning, name, getattr(learning, name))


@pytest.mark.parametrize(("protocol", "strict", "learned"), THOROUGH)
def test_r15_a_refusal_held_up_by_a_standstill_confirms_no_write_and_delivers_no_other_value(
    protocol: str, strict: bool, learned: bool
) -> None:
    for struck, stall in product(STRUCK, OF_MSC if protocol == "msc" else LENGTHS):
        case = Case(protocol, stall, struck, strict, learned)
        outcome = StallSweep(case).run()
        assert not outcome.wrong, (
            f"{outcome.wrong[0]}\nits transcript: python -m tests.verification.campaigns.stalls --replay {case}"
        )
        assert outcome.confirmed
        assert outcome.values


def without_r15(patch: pytest.MonkeyPatch) -> None:
    """Have a master that goes on when a window is over, and remembers nothing."""
    without_max_reply_delay(patch)
    patch.setattr(InSync, "add_overdue", lambda in_sync, *overdue, **more: None)


def test_the_sweep_sees_what_a_master_without_r15_makes_of_a_standstill(monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise it would prove nothing."""
    without_r15(monkeypatch)
    case = Case("hcp2", 0.35, "read")
    outcome = StallSweep(case).run()
    assert outcome.wrong
    shown = transcript(case)
    assert any("damaged, to node" in line for line in shown)
    assert any("WRONG: " in line for line in shown)


@pytest.mark.slow
def test_the_command_counts_and_replays(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    """Here of a master without R15."""
    without_r15(monkeypatch)
    monkeypatch.setattr("sys.argv", ["stalls", "--protocol", "hcp2", "--every", "298", "--first", "34"])
    assert main() == 1
    said = capfd.readouterr().out
    assert "standstills with something wrong" in said
    failed = said.split(":")[0]
    monkeypatch.setattr("sys.argv", ["stalls", "--replay", failed])
    assert main() == 1
    assert " WRONG: " in capfd.readouterr().out
    assert str(Case.parse(failed)) == failed
