"""The core adds, subtracts and compares times, and takes the least and the greatest: nothing else can be explored.

A length of time may be multiplied by a number where both are known. All that is multiplied, divided, negated or rounded
in the rooms of the core stands here, with the reason for which it may.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

CORE = Path(__file__).parents[3] / "busmaster"
ROOMS = (
    *(
        f"arbiter/{name}.py"
        for name in ("arbiter", "backlog", "choice", "deadlines", "dispatcher", "in_sync", "on_wire")
    ),
    *(f"arbiter/{name}.py" for name in ("probes", "shared_backlog", "trust", "unexpected")),
    "contract/driver.py",
)
SET_ASIDE = ("class Alike", "USUAL_SHARE =")
"""What runs as it ships. Not here: counters and their histograms, the budget of probes and what is learned of a node
(health, the class Alike), the schedule of polls: what is set aside is said in shipped.py."""
BYTES = "a number of bytes, of a byte time that is fixed"
COUNT = "numbers of things"
PARAMETER = "a length that is fixed"
ALLOWED = {
    "2 * self.live": COUNT,
    "2 * waiting": COUNT,
    "-next(self._order)": COUNT,
    "key * len(run)": COUNT,
    "run[:1] * len(more)": COUNT,
    "PASSED_BY_EACH * (len(waiting) - 1)": COUNT,
    "turn.passed * turn.client.share": COUNT,
    "seconds / client.share": "what a turn costs: set aside, anybody's may be next",
    "(now - self._since) * cost": "no world has clients with an owner_time",
    "(now - hold.began) * cost": "no world has clients with an owner_time",
    "used * members": "no world has clients with an owner_time",
    "held * members": "no world has clients with an owner_time",
    "time * payer.owner_time * (HELD_TIME if of_hold else 1.0)": "no world has clients with an owner_time",
    "LONGEST_PAUSE * self._pause": "no world has clients with an owner_time",
    "2 * used": "no world has clients with an owner_time",
    "client.owner_time * (now - self._since)": "no world has clients with an owner_time",
    "MOST_BEFORE_URGENT * time": "no world has clients with an owner_time",
    "count * self.byte_time": BYTES,
    "sent * self.byte_time": BYTES,
    "TAINT_SHARE * sent * self.byte_time": BYTES,
    "self.longest * byte_time": BYTES,
    "self.longest * self.byte_time": BYTES,
    "count * self._step.byte_time": BYTES,
    "2 * step.byte_time": BYTES,
    "(len(step.first_bytes) - 1) * step.byte_time": BYTES,
    "(len(run) - 1) * wire.step.byte_time": BYTES,
    "LATE_SHARE * step.timing.window": PARAMETER,
    "LATE_SHARE * paid.awaited.window": PARAMETER,
    "AMBIGUOUS_DELAYS * (overdue.over - overdue.asked)": "both count from one end: a maximum reply delay",
    "awaited * 1000": "a message",
    "REPORT_AGAIN * node.reported_late": "when a late reply is told again: nothing is decided by it",
    "self.unanswered_one[2] / LOOKS": PARAMETER,
    "LATE_REPLY_SHARE * max_reply_delay": PARAMETER,
    "LATE_REPLY_MARGIN * age": "how far a maximum reply delay is raised: set aside, it is any of two",
}
ROUNDING = {"abs", "round", "int", "float", "divmod", "floor", "ceil"}


@pytest.mark.parametrize("room", ROOMS)
def test_the_core_does_no_other_arithmetic(room: str) -> None:
    found = [ast.unparse(node) for node in ast.walk(_code(room)) if _is_other(node)]
    parts = [part for part in found if not any(part != whole and part in whole for whole in found)]
    assert set(parts) <= set(ALLOWED)


def test_all_that_is_allowed_is_somewhere() -> None:
    """What matches nothing would allow what comes later."""
    code = "\n".join(ast.unparse(_code(room)) for room in ROOMS)
    assert not [part for part in ALLOWED if part not in code]


def _code(room: str) -> ast.Module:
    """What runs as it ships of a file."""
    module = ast.parse((CORE / room).read_text())
    module.body = [node for node in module.body if not ast.unparse(node).startswith(SET_ASIDE)]
    return module


def _is_other(node: ast.AST) -> bool:
    match node:
        case ast.BinOp(op=ast.Mult() | ast.Div() | ast.FloorDiv() | ast.Mod() | ast.Pow()):
            return True
        case ast.AugAssign(op=ast.Mult() | ast.Div() | ast.FloorDiv() | ast.Mod() | ast.Pow()):
            return True
        case ast.UnaryOp(op=ast.USub(), operand=ast.Name(id=name)):
            return name != "inf" and not name.isupper()
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant()):
            return False
        case ast.UnaryOp(op=ast.USub()):
            return True
        case ast.Call(func=ast.Name(id=name)):
            return name in ROUNDING
    return False
