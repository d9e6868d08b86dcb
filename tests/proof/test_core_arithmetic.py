"""The core adds, subtracts and compares times, and takes the least and the greatest: nothing else can be explored.

A length of time may be multiplied by a number where both are known. All that is multiplied, divided, negated or rounded
in the rooms of the core stands here, with the reason for which it may.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

CORE = Path(__file__).parent.parent.parent / "busmaster"
ROOMS = (
    *(f"arbiter/{name}.py" for name in ("arbiter", "backlog", "choice", "deadlines", "dispatcher", "echo", "in_step")),
    *(f"arbiter/{name}.py" for name in ("leg", "line_machine", "node_watch", "on_wire", "output", "probes", "queues")),
    *(f"arbiter/{name}.py" for name in ("shared_backlog", "trust", "turns", "unasked", "writes")),
    "contract/driver.py",
)
"""What runs as it ships. Not here: counters and their histograms, the budget of probes and what is learned of a node
(health, alike), the schedule of polls: what is set aside is said in shipped.py."""
BYTES = "a number of bytes, of a byte time that is fixed"
COUNT = "numbers of things"
PARAMETER = "a length that is fixed"
ALLOWED = {
    "2 * self.live": COUNT,
    "-next(self._order)": COUNT,
    "key * len(run)": COUNT,
    "run[:1] * len(more)": COUNT,
    "PASSED_BY_EACH * (len(waiting) - 1)": COUNT,
    "turn.passed * turn.client.share": COUNT,
    "seconds / client.share": "what a turn costs: set aside, anybody's may be next",
    "used * self._members.get(client.owner_time, 1)": "no world has clients with an owner_time",
    "(now - self._since) * (1 + client.owner_time)": "no world has clients with an owner_time",
    "2 * used": "no world has clients with an owner_time",
    "client.owner_time * (now - self._since)": "no world has clients with an owner_time",
    "MOST_BEFORE_URGENT * time": "no world has clients with an owner_time",
    "count * self.byte_time": BYTES,
    "said * self.byte_time": BYTES,
    "TAINT_SHARE * said * self.byte_time": BYTES,
    "self.longest * byte_time": BYTES,
    "count * self._leg.byte_time": BYTES,
    "2 * leg.byte_time": BYTES,
    "(len(leg.first_bytes) - 1) * leg.byte_time": BYTES,
    "(len(run) - 1) * wire.leg.byte_time": BYTES,
    "LATE_SHARE * leg.timing.window": PARAMETER,
    "LATE_SHARE * paid.awaited.window": PARAMETER,
    "DOUBTED_LATENESSES * (debt.over - debt.asked)": "both are reckoned from one end: a lateness",
    "awaited * 1000": "a message",
    "TOLD_AGAIN * node.told_late": "when a late reply is told again: nothing is decided by it",
    "self.unanswered_one[2] / LOOKS": PARAMETER,
    "STRAGGLER_SHARE * lateness": PARAMETER,
    "STRAGGLER_MARGIN * age": "how far a lateness is raised: set aside, it is any of two",
}
ROUNDING = {"abs", "round", "int", "float", "divmod", "floor", "ceil"}


@pytest.mark.parametrize("room", ROOMS)
def test_the_core_does_no_other_arithmetic(room: str) -> None:
    found = [ast.unparse(node) for node in ast.walk(ast.parse((CORE / room).read_text())) if _is_other(node)]
    parts = [part for part in found if not any(part != whole and part in whole for whole in found)]
    assert set(parts) <= set(ALLOWED)


def test_all_that_is_allowed_is_somewhere() -> None:
    """What matches nothing would allow what comes later."""
    code = "\n".join(ast.unparse(ast.parse((CORE / room).read_text())) for room in ROOMS)
    assert not [part for part in ALLOWED if part not in code]


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
