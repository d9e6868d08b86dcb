"""What a state's key leaves out makes no difference, and a wrong omission would be noticed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import inf

import pytest

from busmaster.arbiter.counters import EXCHANGE
from busmaster.arbiter.shared_backlog import SharedBacklog
from tests.verification.proof.forgotten import FORGOTTEN, View, transactions
from tests.verification.proof.kinds import READ, WRITE, WRITE_THERE
from tests.verification.proof.setups import (
    BEYOND,
    CANCELS,
    ECHO_FAULTS,
    FLIPS,
    HEALTH,
    HELD,
    IDLE,
    LOSS,
    LOST,
    NAKS,
    STALLS,
    STRAYS,
    URGENT,
    Setup,
)
from tests.verification.proof.twins import Differs, walk
from tests.verification.proof.worlds import LEARNED

HCP2 = Setup(commands=(READ, WRITE), adversary=(STRAYS, LOST, CANCELS, LOSS))
PACED = replace(HCP2, paced=True, adversary=(STRAYS, NAKS), retries=1)
ECHOES = replace(HCP2, echo=True, adversary=(ECHO_FAULTS, STRAYS))
LATE = replace(HCP2, receive_latency=0.016, adversary=(STALLS, FLIPS))
QUEUES = replace(HCP2, commands=(READ, WRITE, WRITE_THERE), depth=2, adversary=(IDLE, URGENT, NAKS), retries=1)
HOLDS = replace(HCP2, adversary=(HELD, STRAYS))
DIES = replace(HCP2, commands=(READ, WRITE_THERE), adversary=(HEALTH, URGENT, LOST, NAKS))
MSC = replace(HCP2, kind="msc", lapse=2.5, adversary=(STRAYS, FLIPS), lost_acknowledgements=1)
OVERDUE_FROM = replace(HCP2, in_sync=True, adversary=(BEYOND, NAKS), beyond=0.3)
LEARNS = replace(OVERDUE_FROM, adversary=(), beyond=0.15, lapse=0.2, retries=1, whole=True, learned=LEARNED)
SHARED = replace(QUEUES, clients=1, adversary=(URGENT, CANCELS, LOST))
SEQUENCES = replace(HCP2, clients=1, longest_hold=0.3, adversary=(URGENT, CANCELS, LOST), retries=1)
EVERY = {"hcp2": HCP2, "paced": PACED, "echo": ECHOES, "late": LATE, "queues": QUEUES, "held": HOLDS, "msc": MSC}
EVERY |= {"shared": SHARED, "sequences": SEQUENCES, "dies": DIES}
pytestmark = pytest.mark.timeout(300)


@pytest.mark.slow
@pytest.mark.parametrize("walks", [15, pytest.param(40, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("setup", [*EVERY.values(), OVERDUE_FROM, LEARNS], ids=[*EVERY, "owes", "learns"])
def test_a_world_that_was_restored_from_its_key_has_the_same_fate(setup: Setup, walks: int) -> None:
    assert sum(walk(setup, seed) for seed in range(walks)) > walks


def without_quarantine(view: View) -> None:
    view.world.arbiter._quarantine = -inf


def without_last_byte(view: View) -> None:
    view.world.arbiter._unexpected.last_byte = -inf


def without_end(view: View) -> None:
    if view.world.arbiter.state is not EXCHANGE:
        view.world.arbiter._step.end = -inf


def without_end_of_the_step_on_the_wire(view: View) -> None:
    if view.world.arbiter.state is EXCHANGE:
        view.world.arbiter._step.end = -inf


def without_limit(view: View) -> None:
    view.world.arbiter._step.longest = 0


def without_taint(view: View) -> None:
    view.world.arbiter._step.taint_until = -inf


def without_resynchronisation(view: View) -> None:
    view.world.arbiter._silent_at = -inf


def without_packet(view: View) -> None:
    view.world.arbiter._step._follows = None


def without_echo(view: View) -> None:
    view.world.arbiter._echo.pending = b""


def without_refusals(view: View) -> None:
    for transaction in transactions(view.world):
        transaction.refusals = 0


def without_retries(view: View) -> None:
    for transaction in transactions(view.world):
        transaction.retried = 0


def without_doubt(view: View) -> None:
    for transaction in transactions(view.world):
        transaction.unsure = False
        transaction.attempts = 0


def without_overdue_replies(view: View) -> None:
    del view.world.arbiter._in_sync.overdue_replies[1:]


def without_what_is_awaited(view: View) -> None:
    for overdue in view.world.arbiter._in_sync.overdue_replies:
        overdue.awaited = None


def without_lapse(view: View) -> None:
    for overdue in view.world.arbiter._in_sync.overdue_replies:
        overdue.asked = inf


def without_what_is_held(view: View) -> None:
    view.world.arbiter._wire.output.held = False


def without_what_is_being_said(view: View) -> None:
    view.world.arbiter._step.out = -inf


def without_what_began(view: View) -> None:
    backlog = view.world.arbiter.dispatcher.backlog
    if isinstance(backlog, SharedBacklog):
        backlog._last = None


def without_when_it_began(view: View) -> None:
    backlog = view.world.arbiter.dispatcher.backlog
    if isinstance(backlog, SharedBacklog):
        backlog._since = -inf


@pytest.mark.slow
@pytest.mark.parametrize(
    ("forget", "setup"),
    [
        (without_quarantine, HCP2),
        (without_last_byte, replace(MSC, bytewise=True, adversary=(LOST,))),
        (without_end, HCP2),
        (without_end_of_the_step_on_the_wire, HCP2),
        (without_limit, LATE),
        (without_taint, PACED),
        (without_resynchronisation, replace(MSC, echo=True, adversary=(STRAYS, ECHO_FAULTS))),
        (without_packet, MSC),
        (without_echo, ECHOES),
        (without_refusals, PACED),
        (without_retries, QUEUES),
        (without_doubt, HCP2),
        (without_overdue_replies, OVERDUE_FROM),
        (without_lapse, OVERDUE_FROM),
        (without_what_is_awaited, LEARNS),
        (without_what_is_held, HOLDS),
        (without_what_is_being_said, MSC),
        (without_what_began, SEQUENCES),
        (without_when_it_began, SEQUENCES),
    ],
    ids=lambda value: value.__name__ if callable(value) else "",
)
def test_a_wrong_omission_is_noticed(forget: Callable[[View], None], setup: Setup) -> None:
    for seed in range(480):
        try:
            walk(setup, seed, [*FORGOTTEN, forget])
        except Differs:
            return
    pytest.fail("nothing differed")
