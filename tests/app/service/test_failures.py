"""Errors on their way to a client: their classes, their causes, and errors that have no class there."""

from __future__ import annotations

from itertools import pairwise

import msgspec
import pytest

from busmaster import BusError, NoReply, errors
from busmaster.app.service.failures import DEEPEST, KNOWN, encode_error, error_of, refusal_of
from busmaster.app.service.fields import shortened
from busmaster.app.service.messages import BUS_ERROR, INTERNAL, INVALID_PARAMS, NO_METHOD, InvalidParams, Malformed
from busmaster.app.service.owner_messages import ErrorForm
from busmaster.errors import InvalidCommand, Refused
from busmaster.ext import CommandOptions


def sent(error: Exception) -> Exception:
    """Return the error at the client."""
    return error_of(msgspec.json.decode(msgspec.json.encode(encode_error(error)), type=ErrorForm))


class NoReplyOfAModem(NoReply):
    """An error of an application."""


class FaultOfAnApplication(BusError):
    """Another one, whose nearest known class is BusError."""


def test_an_error_of_an_application_has_its_nearest_known_class() -> None:
    for error, kind in ((NoReplyOfAModem("no carrier"), NoReply), (FaultOfAnApplication("no carrier"), BusError)):
        again = sent(error)
        assert isinstance(again, BusError)
        assert (type(again), again.what) == (kind, "no carrier")


def test_an_error_of_a_later_version_is_a_bus_error() -> None:
    form = encode_error(NoReply("no reply", attempts=2))
    assert isinstance(form.data, msgspec.Raw)
    later = msgspec.Raw(bytes(form.data).replace(b'"NoReply"', b'"Eclipse"'))
    again = error_of(msgspec.structs.replace(form, data=later))
    assert isinstance(again, BusError)
    assert (type(again), again.what, again.attempts) == (BusError, "no reply", 2)


def test_only_so_many_causes_of_an_error_are_sent_and_others_than_bus_errors_as_text() -> None:
    errors = [NoReply(f"cause {number}") for number in range(DEEPEST + 3)]
    for error, cause in pairwise(errors):
        error.__cause__ = cause
    causes, again = list[str](), sent(errors[0])
    while again.__cause__ is not None:
        assert isinstance(again.__cause__, NoReply)
        again = again.__cause__
        causes.append(again.what)
    assert causes == [f"cause {number + 1}" for number in range(DEEPEST)]
    error = NoReply("no reply")
    error.__cause__ = ValueError("no digit")
    shown = sent(error).__cause__
    assert (type(shown), str(shown)) == (Exception, "ValueError: no digit")


@pytest.mark.parametrize("confirm", [True, False])
@pytest.mark.parametrize("temporary", [True, False])
def test_a_refusal_keeps_whether_it_is_final_and_whether_it_can_be_confirmed(confirm: bool, temporary: bool) -> None:
    refused = Refused("busy", confirm=confirm)
    refused.temporary = temporary
    again = sent(refused)
    assert isinstance(again, Refused)
    assert (again.confirm, again.temporary) == (confirm, temporary)


def test_a_refusal_that_does_not_have_these_fields_can_be_confirmed_and_is_final() -> None:
    form = encode_error(Refused("busy"))
    assert isinstance(form.data, msgspec.Raw)
    earlier = bytes(form.data).replace(b',"confirm":true', b"")
    assert b"confirm" not in earlier
    again = error_of(msgspec.structs.replace(form, data=msgspec.Raw(earlier)))
    assert isinstance(again, Refused)
    assert (again.confirm, again.temporary) == (True, False)


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (Malformed("no method 'x'", NO_METHOD), NO_METHOD, "no method 'x'"),
        (InvalidCommand("no such element"), INVALID_PARAMS, "no such element"),
        (NoReply("no reply"), BUS_ERROR, str(NoReply("no reply"))),
        (ValueError("no digit"), INTERNAL, "ValueError: no digit"),
    ],
)
def test_an_error_has_the_code_of_its_kind(error: Exception, code: int, text: str) -> None:
    form = encode_error(error)
    assert (form.code, form.message) == (code, text)


def test_an_error_without_a_class_is_the_owners() -> None:
    again = error_of(ErrorForm(INTERNAL, "ValueError: no digit"))
    assert isinstance(again, BusError)
    assert again.what == "the program that owns the line could not do it: ValueError: no digit"
    assert again.hint == "see its log"


def test_an_exception_of_a_value_is_refused_with_its_method() -> None:
    refused = refusal_of("write", TypeError("a list is not a number"))
    assert isinstance(refused, InvalidParams)
    assert str(refused).startswith("write: TypeError: a list is not a number; ")
    for error in (NoReply("x"), InvalidCommand("x"), Malformed("x")):
        assert refusal_of("write", error) is error


def test_the_hint_of_a_class_is_kept() -> None:
    again = sent(NoReply("no reply"))
    assert isinstance(again, BusError)
    assert again.hint == NoReply("no reply").hint


def test_shorter_options_are_a_copy() -> None:
    given: CommandOptions = {"start_within": 0.0, "finish_within": 1.0}
    assert shortened(given, 2.0) == {"start_within": 0.0, "finish_within": 0.0}
    assert given == {"start_within": 0.0, "finish_within": 1.0}


def test_each_error_of_the_library_keeps_its_class_on_the_way_to_a_client() -> None:
    classes = {name for name in errors.__all__ if name not in ("Addressed", "InvalidCommand")}
    assert set(KNOWN) == classes
    assert all(KNOWN[name] is getattr(errors, name) for name in classes)
