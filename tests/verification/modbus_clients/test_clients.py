"""The run with several Modbus TCP clients finds a wrong value, and finds none with the clients that are installed."""

from __future__ import annotations

import subprocess
import sys

import pytest

from benchmarks.served_line import value_of
from tests.patience import PATIENCE
from tests.verification.modbus_clients.__main__ import OWN_REGISTER, POINTS, ROOT, Judged, code_of_text, steps_of


def judged(*replies: tuple[str, int, int, int, int, list[int]]) -> Judged:
    one = Judged("a client", len(replies))
    for *step, code, values in replies:
        one.judge(tuple(step), code, values)  # type: ignore[arg-type]
    return one


def test_a_reply_of_another_unit_register_or_length_is_a_wrong_value() -> None:
    right = [value_of(3, 10), value_of(3, 11)]
    assert judged(("read", 3, 10, 2, 0, right)).wrong == []
    for values in ([value_of(4, 10), value_of(4, 11)], [value_of(3, 11), value_of(3, 12)], right[:1]):
        assert len(judged(("read", 3, 10, 2, 0, values)).wrong) == 1
    assert len(judged(("read", POINTS, 4, 4, 0, [0, 0, 0, 0])).wrong) == 1


def test_a_register_holds_what_was_confirmed_and_after_an_unconfirmed_write_either_value() -> None:
    own = OWN_REGISTER
    first = ("write", 3, own, 7, 0, list[int]())
    assert judged(first, ("read", 3, own, 1, 0, [7])).wrong == []
    assert len(judged(first, ("read", 3, own, 1, 0, [value_of(3, own)])).wrong) == 1
    unconfirmed = ("write", 3, own, 8, 11, list[int]())
    for value, wrong in ((7, 0), (8, 0), (9, 1)):
        assert len(judged(first, unconfirmed, ("read", 3, own, 1, 0, [value])).wrong) == wrong
    assert judged(first, unconfirmed).codes == {11: 1}


def test_clients_read_back_what_they_wrote_to_the_same_unit() -> None:
    steps = steps_of(2, 1000)
    pairs = [(step, steps[place + 1]) for place, step in enumerate(steps) if step[0] == "write"]
    assert len(pairs) == 100
    assert all(after[:3] == ("read", *write[1:3]) for write, after in pairs)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("Read output (holding) register failed: Target device failed to respond", 11),
        ("Read output (holding) register failed: Gateway path unavailable", 10),
        ("Read output (holding) register failed: Slave device or server is busy", 6),
        ("Read output (holding) register failed: Illegal data address", 2),
        ("Read output (holding) register failed: Connection timed out", -1),
    ],
)
def test_an_exception_that_mbpoll_names_has_its_code(text: str, code: int) -> None:
    assert code_of_text(text) == code


@pytest.mark.slow
def test_the_installed_clients_share_a_line_that_loses_frames_without_a_wrong_value() -> None:
    ran = subprocess.run(
        [sys.executable, "-m", "tests.verification.modbus_clients", "--requests", "120", "--unpaced"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "pymodbus: " in ran.stdout
    assert "owner: " in ran.stdout
