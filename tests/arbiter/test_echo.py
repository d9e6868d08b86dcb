"""The echo of sent bytes: what is removed, and until when received bytes may be our own."""

from __future__ import annotations

from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.on_wire import Echo


def test_after_an_incomplete_echo_bytes_may_be_our_own_until_an_echo_is_complete() -> None:
    echo = Echo(declared=True)
    echo.sent(b"abc")
    assert echo.strip(b"ab") == b""
    echo.forget()
    assert echo.astray
    echo.sent(b"def")
    assert echo.strip(b"de") == b""
    assert echo.astray
    assert echo.strip(b"freply") == b"reply"
    assert not echo.astray


def test_an_echo_that_differs_is_a_collision_and_nothing_of_it_is_removed_later() -> None:
    echo = Echo(declared=True)
    echo.sent(b"abc")
    assert echo.strip(b"ax") is None
    assert echo.astray
    assert echo.pending == b""


def test_without_an_echo_nothing_is_removed() -> None:
    echo = Echo(declared=False)
    echo.sent(b"abc")
    assert echo.strip(b"abc") == b"abc"


def test_a_line_has_no_echo_unless_it_is_declared() -> None:
    assert not Arbiter(0.001)._echo.declared
