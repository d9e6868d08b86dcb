"""The limits of a command that arrives as text; tests/app/outputs/test_mqtt.py has its forms."""

from __future__ import annotations

import json
from typing import Any

import pytest

from busmaster.app.bounds import LARGEST_VALUE, LONGEST_COMMAND, LONGEST_ID
from busmaster.app.service.payload import LATEST, NoCommand, Payload, read_payload


@pytest.mark.parametrize(
    ("payload", "expected"),
    [
        ("1".ljust(LONGEST_COMMAND), Payload(1)),
        (1, Payload(1)),
        (bytearray(b"[-1]"), Payload([-1])),
        (json.dumps({"value": 1, "id": "x" * LONGEST_ID}), Payload(1, "x" * LONGEST_ID)),
        ('{"value": 1, "id": -7}', Payload(1, "-7")),
        ('{"value": 1, "id": 0}', Payload(1, "0")),
        ('{"value": 0, "id": "0"}', Payload(0, "0")),
        ('{"value": 1, "id": ""}', Payload(1)),
        (json.dumps([LARGEST_VALUE, -LARGEST_VALUE]), Payload([LARGEST_VALUE, -LARGEST_VALUE])),
        (json.dumps({"value": 1, "expires": LATEST}), Payload(1, "", LATEST)),
        ('{"value": 1, "expires": 0}', Payload(1, "", 0)),
        ('{"value": 1, "expires": null}', Payload(1)),
    ],
    ids=range(12),
)
def test_a_command_at_its_limit_is_read(payload: Any, expected: Payload) -> None:
    found = read_payload(payload)
    assert found == expected
    assert type(found.id) is str


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        ("1".ljust(LONGEST_COMMAND + 1), f"at most {LONGEST_COMMAND} bytes, not {LONGEST_COMMAND + 1}"),
        ("\u00e4" * (LONGEST_COMMAND // 2 + 1), f"at most {LONGEST_COMMAND} bytes"),
        (json.dumps({"value": 1, "id": "x" * (LONGEST_ID + 1)}), "an id must be a whole number, or a text"),
        (json.dumps({"value": 1, "id": 10**LONGEST_ID}), "an id must be a whole number, or a text"),
        ('{"value": 1, "id": true}', "an id must be"),
        ('{"value": 1, "id": false}', "an id must be"),
        ('{"value": 1, "id": []}', "an id must be"),
        ('{"value": 1, "id": 1.5}', "an id must be"),
        ('{"value": 1, "id": null}', "an id must be"),
        ("[1, true]", "is neither a number nor a list of numbers"),
        ('[1, "2"]', "is neither a number nor a list of numbers"),
        ("Infinity", "'Infinity' is neither a number nor a list of numbers"),
        ('{"value": []}', "is neither a number nor a list of numbers"),
        ("-1e308", "is larger than 1e\\+15"),
        ("[1, -1e308]", "is larger than 1e\\+15"),
        ('{"value": 1, "expires": true}', "expires must be a time in seconds since 1970$"),
        ('{"value": 1, "expires": ""}', "expires must be a time in seconds since 1970$"),
        ('{"value": 1, "expires": 100000000001}', "in seconds since 1970, not in milliseconds"),
        ('{"expires": 1}', "is not a command; use"),
        ('{"value": 1, "valu": 2}', "is not a command; use"),
    ],
    ids=range(20),
)
def test_a_command_beyond_its_limit_is_refused_with_the_reason(payload: str, reason: str) -> None:
    with pytest.raises(NoCommand, match=reason):
        read_payload(payload)
