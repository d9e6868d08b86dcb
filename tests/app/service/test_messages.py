"""The types of messages: each is encoded and decoded, unknown fields are ignored, and a wrong type is refused."""

from __future__ import annotations

import json
from collections.abc import Iterator
from math import inf, nan
from pathlib import Path
from typing import Any, get_args

import msgspec
import pytest

from busmaster import Hcp2Controller, Priority, RemoteBus, ext
from busmaster.app import bounds
from busmaster.app.service.client_messages import CancelParams, NodeParams, NoParams, RequestParams, WriteParams
from busmaster.app.service.client_requests import Reading, client_request_of
from busmaster.app.service.connection import Connection
from busmaster.app.service.failures import encode_error, error_of
from busmaster.app.service.fields import NonFinite, OptionsForm
from busmaster.app.service.messages import (
    CLIENT_NOTIFICATIONS,
    OWNER_NOTIFICATIONS,
    PARSE_ERROR,
    REQUESTS,
    InvalidParams,
    Malformed,
    decode_client_message,
    decode_client_notification,
    decode_owner_message,
    decode_owner_notification,
    decode_request_params,
    decode_result,
    encode,
    encode_error_reply,
    encode_json,
    encode_notification,
    encode_number,
    encode_request,
    encode_result,
    encode_value,
    reason_of,
    value_of,
)
from busmaster.app.service.owner_messages import EventForm
from busmaster.app.service.reply_times import encode_timings, timings_of
from busmaster.contract.learning import Learned
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.errors import BacklogFull, InvalidCommand, Refused
from tests.app.service import schema
from tests.app.service.lines import Served, on_a_line, on_a_served_line, raw

COMMAND = {"command": "read", "element": 1}
NODE = {"protocol": "hcp2", "address": 5}
READ = {**NODE, "command": COMMAND}
TIMING = {
    "late_after": 0.1,
    "window": 0.1,
    "max_reply_delay": 0.2,
    "inter_byte_timeout": 0.01,
    "driver_release_time": 0.0,
}
TIMINGS = {"read": TIMING, "write": TIMING, "packet": {**TIMING, "silence": 0.1}}
POINT = {"key": "5/1", "item": "1", "unit": "", **READ}
OPTIONS = {"priority": 1, "start_within": 1.0, "finish_within": 2.0, "retries": 3, "idempotent": True}
PLANNED = {
    "name": "axes",
    "period": 0.1,
    "phase": 0.0,
    "priority": 3,
    "reads": [{**READ, "timings": {"learned": TIMINGS}, "reply_time": 0.1}],
}
REQUEST = {"touches": COMMAND, "options": OPTIONS, "stops_seen": 1, "stop": True, "requested": 1.5, "sequence": 2}
PARAMS: dict[str, dict[str, Any]] = {
    "hello": {"versions": [3], "program": "mine", "safe_only": True},
    "node": {**NODE, "timings": TIMINGS, "retries": 1, "probe": COMMAND, "sync_reads": [COMMAND]},
    "request": {**READ, **REQUEST},
    "check": {**NODE, "commands": [COMMAND], "stop": True},
    "safe": {"writes": {"5/1": 0.0}},
    "now": {},
    "statistics": {},
    "groups": {},
    "plan": {"groups": [PLANNED]},
    "subscribe": {"group": "axes", "stream": 1},
    "gather": {"stream": 1, "points": [POINT]},
    "poll": {"name": "axes", "period": 0.1, "stream": 1, "points": [POINT], "phase": 0.0, "priority": 3},
    "events": {"stream": 1},
    "exchanges": {"stream": 1},
    "overview": {"stream": 1},
    "details": {"group": "axes", "key": "5/1"},
    "write": {"group": "axes", "key": "5/1", "value": 1, "options": OPTIONS, "requested": 1.5},
    "pause": {"group": "axes", "paused": True},
    "demand": {"group": "axes"},
    "suspend": {**NODE, "for": 1.0},
}
NOTIFICATIONS: dict[str, dict[str, Any]] = {
    "cancel": {"id": 1},
    "refusals": {"interface": "web", "kind": "logins", "peers": {"10.0.0.1": 1}},
    "stop": NODE,
    "hold": {"sequence": 1, **NODE, "max_hold": 0.5},
    "release": {"sequence": 1},
    "end": {"stream": 1},
}
FREE = ("command", "commands", "touches", "probe", "sync_reads", "writes", "peers", "options")
"""Fields whose names belong to the protocol or the user; and options, of which an unknown one is refused."""


def raw_of(params: Any) -> msgspec.Raw:
    return msgspec.Raw(json.dumps(params).encode())


def decode(method: str, params: Any) -> Any:
    decoder = decode_request_params if method in REQUESTS else decode_client_notification
    return decoder(method, raw_of(params))


def with_unknown_fields(value: Any) -> Any:
    """Return the same with a further field in each object that has a type."""
    if isinstance(value, dict):
        parts = {name: part if name in FREE else with_unknown_fields(part) for name, part in value.items()}
        return {**parts, "colour": [{"red": 1}]}
    return [with_unknown_fields(part) for part in value] if isinstance(value, list) else value


def wrong_values() -> Iterator[tuple[str, dict[str, Any], str]]:
    """Yield each message with one field of a wrong type, and the name of the field."""
    for method, params in (PARAMS | NOTIFICATIONS).items():
        for name, part in params.items():
            if name != "value":  # its type is the protocol's affair
                yield method, {**params, name: 5 if isinstance(part, str) else "text"}, name
                yield method, {**params, name: 1 if isinstance(part, bool) else True}, name


def required_fields() -> Iterator[tuple[str, str]]:
    """Yield each message with each of its required fields."""
    types = {method: types.params for method, types in REQUESTS.items()} | dict(CLIENT_NOTIFICATIONS)
    for method, params in types.items():
        yield from ((method, field.encode_name) for field in msgspec.structs.fields(params) if field.required)


def test_every_message_of_a_client_is_in_this_file() -> None:
    assert PARAMS.keys() == REQUESTS.keys()
    assert NOTIFICATIONS.keys() == CLIENT_NOTIFICATIONS.keys()


@pytest.mark.parametrize("method", [*PARAMS, *NOTIFICATIONS])
def test_a_message_is_decoded_and_encoded_again_without_a_change(method: str) -> None:
    params = (PARAMS | NOTIFICATIONS)[method]
    decoded = decode(method, params)
    if method in REQUESTS:
        message = json.loads(encode_request(method, 7, decoded))
        assert message == {"jsonrpc": "2.0", "id": 7, "method": method, "params": params}
    else:
        message = json.loads(encode_notification(method, decoded))
        assert message == {"jsonrpc": "2.0", "method": method, "params": params}
    schema.check_program(message)


@pytest.mark.parametrize("method", [*PARAMS, *NOTIFICATIONS])
def test_unknown_fields_are_ignored(method: str) -> None:
    params = (PARAMS | NOTIFICATIONS)[method]
    assert decode(method, with_unknown_fields(params)) == decode(method, params)


@pytest.mark.parametrize(("method", "params", "name"), list(wrong_values()), ids=lambda value: str(value)[:20])
def test_a_field_of_a_wrong_type_is_refused_with_its_name(method: str, params: dict[str, Any], name: str) -> None:
    with pytest.raises(
        InvalidParams, match=rf"^{method}: {name}: expected .*; service.schema.json has its parameters$"
    ):
        decode(method, params)


@pytest.mark.parametrize(("method", "name"), list(required_fields()))
def test_a_missing_field_is_refused_with_its_name(method: str, name: str) -> None:
    params = {key: part for key, part in (PARAMS | NOTIFICATIONS)[method].items() if key != name}
    with pytest.raises(InvalidParams, match=f"^{method}: '{name}' is missing; "):
        decode(method, params)


@pytest.mark.parametrize(
    ("method", "more", "reason"),
    [
        ("request", {"options": {"safe": True}}, "options: object contains unknown field `safe`"),
        ("request", {"options": {"priority": 4}}, "options.priority: invalid enum value 4"),
        ("request", {"options": {"retries": ext.MOST_RETRIES + 1}}, "options.retries: expected `int` <= 100"),
        ("request", {"address": 5.0}, "address: expected `int`, got `float`"),
        ("request", {"address": -1}, "address: expected `int` >= 0"),
        ("request", {"address": 2**31 + 1}, "address: expected `int` <= 2147483648"),
        ("request", {"sequence": -1}, "sequence: expected `int` >= 0"),
        ("check", {"commands": [COMMAND] * (bounds.MOST_CHECKED + 1)}, "commands: expected `array` of length <= 64"),
        ("node", {"sync_reads": []}, "sync_reads: expected `array` of length >= 1"),
        ("node", {"sync_reads": [COMMAND] * (bounds.MOST_SYNC_READS + 1)}, "sync_reads: expected `array` of length <="),
        ("node", {"timings": {"read": {**TIMING, "window": -1}}}, "timings.read.window: expected `float` >= 0"),
        ("gather", {"points": [POINT] * (bounds.MOST_POLLED_POINTS + 1)}, "points: expected `array` of length <= 1000"),
        ("poll", {"points": [POINT] * (bounds.MOST_POLLED_POINTS + 1)}, "points: expected `array` of length <= 1000"),
        ("events", {"stream": 2**53 + 1}, "stream: expected `int` <= 9007199254740992"),
        ("suspend", {"for": -1}, "for: expected `float` >= 0"),
        ("poll", {"phase": -0.1}, "phase: expected `float` >= 0"),
        ("plan", {"groups": [{**PLANNED, "period": ext.SHORTEST_PERIOD / 2}]}, "groups[0].period: expected"),
        ("plan", {"groups": [{**PLANNED, "period": ext.LONGEST_PERIOD + 1}]}, "groups[0].period: expected"),
    ],
)
def test_a_value_beyond_its_limit_is_refused_with_the_limit(method: str, more: dict[str, Any], reason: str) -> None:
    with pytest.raises(InvalidParams) as refusal:
        decode(method, {**PARAMS[method], **more})
    assert str(refusal.value).startswith(f"{method}: {reason}")


@pytest.mark.parametrize(
    "params", ["[" * 900, "[" * 60_000, "{}{}", "[]", "null", "7", "1" * 5000, "1e999", '{"stream":1e999}', "NaN"]
)
def test_parameters_that_are_not_an_object_are_refused(params: str) -> None:
    with pytest.raises(InvalidParams, match=r"^events: "):
        decode_request_params("events", msgspec.Raw(params.encode()))


@pytest.mark.parametrize(
    ("timings", "reason"),
    [
        ({**TIMINGS, "learned": None}, "learned excludes read, write and packet"),
        ({"packet": TIMING, "learned": None}, "learned excludes read, write and packet"),
        ({"read": TIMING}, "write and packet missing"),
        ({}, "read and write and packet missing"),
    ],
)
def test_reply_times_are_complete_or_learned(timings: dict[str, Any], reason: str) -> None:
    with pytest.raises(InvalidCommand, match=reason):
        timings_of(decode("node", {**NODE, "timings": timings}).timings)
    with pytest.raises(schema.ValidationError):
        schema.check("node_params", {**NODE, "timings": timings})


READ_TIMES, WRITE_TIMES = ReplyTiming(0.01, 0.02, 0.03, 0.004, 0.005, 0.06), ReplyTiming(0.07, 0.08, 0.09, 0.01)
TIMES = Timings(READ_TIMES, WRITE_TIMES, ReplyTiming(0.11, 0.12, 0.13, 0.014, 0.015))


@pytest.mark.parametrize("times", [None, TIMES, Learned(), Learned(TIMES)])
def test_reply_times_are_received_as_they_were_sent(times: Timings | Learned | None) -> None:
    sent = encode(NodeParams("hcp2", 5, encode_timings(times)))
    assert timings_of(decode_request_params("node", msgspec.Raw(sent)).timings) == times


@pytest.mark.parametrize("step", ["read", "write", "packet"])
@pytest.mark.parametrize("name", ["max_reply_delay", "inter_byte_timeout", "driver_release_time", "silence"])
def test_a_reply_is_awaited_for_five_seconds_at_most(step: str, name: str) -> None:
    def times(longest: float) -> dict[str, Any]:
        return {**TIMINGS, step: {**TIMING, name: longest}}

    for form in (times(bounds.LONGEST_REPLY), {"learned": times(bounds.LONGEST_REPLY)}):
        assert timings_of(decode("node", {**NODE, "timings": form}).timings)
    for form in (times(bounds.LONGEST_REPLY + 0.001), {"learned": times(bounds.LONGEST_REPLY + 0.001)}):
        with pytest.raises(InvalidCommand, match="may have the line wait 5 s for a reply, and no longer"):
            timings_of(decode("node", {**NODE, "timings": form}).timings)


@pytest.mark.parametrize("method", [method for method in PARAMS if PARAMS[method]])
def test_the_schema_does_not_permit_a_field_that_no_message_has(method: str) -> None:
    with pytest.raises(schema.ValidationError):
        schema.check(f"{method}_params", {**PARAMS[method], "colour": "red"})


def test_the_last_of_two_equal_names_counts() -> None:
    assert decode_client_notification("cancel", msgspec.Raw(b'{"id":1,"id":2}')) == CancelParams(2)


# envelopes


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "not valid JSON"),
        ('{"jsonrpc":"2.0","method":"now"', "not valid JSON"),
        ('{"jsonrpc":"2.0","method":"now"} x', "not valid JSON"),
        ('{"jsonrpc":"2.0","method":"now","more":' + "[" * 8000, "not valid JSON"),
        ('{"jsonrpc":"2.0","method":"now","params":' + '{"a":' * 8000, "not valid JSON"),
        ("7", "not a message of JSON-RPC 2.0"),
        ('{"method":"now"}', "not a message of JSON-RPC 2.0"),
        ('{"jsonrpc":2.0,"method":"now"}', "not a message of JSON-RPC 2.0"),
        ('{"jsonrpc":"2.0","method":null}', "a message has a method"),
        ('{"jsonrpc":"2.0","id":1}', "a message has a method"),
        ('{"jsonrpc":"2.0","method":"now","id":"1"}', "the id of a request is a whole number"),
        ('{"jsonrpc":"2.0","method":"now","id":1.0}', "the id of a request is a whole number"),
        ('{"jsonrpc":"2.0","method":"now","id":%s}' % ("1" * 5000), "the id of a request is a whole number"),
        (b"{}", "a message is text"),
    ],
    ids=range(14),
)
def test_an_invalid_envelope_is_malformed(text: str | bytes, reason: str) -> None:
    with pytest.raises(Malformed, match=reason) as refusal:
        decode_client_message(text)
    assert (refusal.value.code == PARSE_ERROR) == (reason == "not valid JSON")
    # JSON-RPC 2.0: parse error, invalid request
    assert encode_error(refusal.value).code == (-32700 if reason == "not valid JSON" else -32600)


@pytest.mark.parametrize("text", ["{", "[]", '{"jsonrpc":"2.0","id":"1","result":1}', 50_000 * "[", b"{}"])
def test_an_invalid_message_of_the_owner_is_malformed(text: str | bytes) -> None:
    with pytest.raises(Malformed):
        decode_owner_message(text)


def test_an_envelope_may_have_a_large_number_and_further_fields() -> None:
    message = decode_client_message(f'{{"jsonrpc":"2.0","id":{10**30},"method":"now","trace":{{"a":[1]}}}}')
    assert (message.id, message.method, bytes(message.params)) == (10**30, "now", b"{}")
    assert decode_client_message('{"jsonrpc":"2.0","method":"now","id":null}').id is None


def test_a_message_with_too_many_values_is_not_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busmaster.app.service.messages._CLIENT_MESSAGE", None)
    with pytest.raises(Malformed, match="at most 8192 values"):
        decode_client_message("[" * (bounds.MOST_PARTS + 1))


def test_an_unknown_method_is_refused_and_an_unknown_notification_is_ignored() -> None:
    with pytest.raises(Malformed, match="no method 'erase'"):
        decode_request_params("erase", raw_of({}))
    assert decode_client_notification("erase", raw_of([])) is None
    assert decode_owner_notification("erase", raw_of([])) is None


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("Expected `object`, got `array`", "expected `object`, got `array`"),
        ("Expected `int`, got `str` - at `$.a[0].b`", "a[0].b: expected `int`, got `str`"),
        ("Object missing required field `b`", "'b' is missing"),
        ("Object missing required field `b` - at `$.a`", "'a.b' is missing"),
    ],
)
def test_a_reason_begins_with_the_name_of_the_field(text: str, expected: str) -> None:
    assert reason_of(ValueError(text)) == expected


# messages of the owner

STREAM = {"stream": 1, "dropped": 2}
ROW = {
    "group": "a",
    "key": "b",
    "node": "c",
    **NODE,
    "kind": "hcp2",
    "item": "1",
    "unit": "",
    "precision": None,
    "writable": True,
}
GROUP = {"name": "a", "period": 0.1, "paused": False, "cycles": 1, "missed": 0, "achieved": 0.1, "jitter": 0.0}
COUNTS = {"requests": 1, "failed": 0, "late": 0, "p50": 0.1, "p99": 0.1}
FRAME = {
    "set": 1,
    "title": "a",
    "line": "b",
    "settings": "",
    "read_only": False,
    "now": 1.0,
    "elapsed": 1.0,
    "state": "ready",
    "why": "",
    "since": None,
    "utilisation": 0.5,
    "backlog": 0,
    "losses": 0,
    "groups": 0,
    "nodes": 0,
    "points": 0,
    "left_out": 0,
    "events": [[1.0, "a"]],
}
SNAPSHOT = {
    "set": 1,
    "cycle": 1,
    "due": 1.0,
    "started": None,
    "finished": 2.0,
    "missed": 0,
    "wall": 3.0,
    "samples": [[1.5, None, 1.0, None, 2.0, 3.0, "good", [1.0, None, None, None, 1, 0, 0.0]]],
}
SHOWN = [None, [{"float": "inf"}, "good", 1.0, "", "high"], [7, "bad", 1.0, "", ""]]
BODIES: dict[str, Any] = {
    "points": {"set": 1, "points": [POINT]},
    "snapshot": SNAPSHOT,
    "event": {"event": "LineChanged", "change": "down", "cause": "unplugged"},
    "ended": {},
    "exchanges": {"now": 1.0, "left_out": 0, "exchanges": [[[[1, "node", "ff"]], 1]]},
    "frame": FRAME,
    "rows": {"set": 1, "first": 0, "rows": [ROW]},
    "values": {"set": 1, "first": 0, "values": SHOWN},
    "groups": {"first": 0, "groups": [GROUP]},
    "nodes": {"first": 0, "nodes": [{"label": "a", **NODE, "kind": "hcp2", "health": "suspended", **COUNTS}]},
}
FROM_OWNER: dict[str, Any] = {
    "stops": {**NODE, "stops": 1},
    "access": {"read_only": True},
    "poll_groups": {"groups": [{"name": "axes", "period": 0.1}]},
    "touched": {**NODE, "when": 1.0, "all": False, "items": ["1"]},
    **{method: {**STREAM, "body": body} for method, body in BODIES.items()},
}


def test_every_notification_of_the_owner_is_in_this_file() -> None:
    assert FROM_OWNER.keys() == OWNER_NOTIFICATIONS.keys()


@pytest.mark.parametrize("method", FROM_OWNER)
def test_a_notification_of_the_owner_is_decoded_and_encoded_again_without_a_change(method: str) -> None:
    params = FROM_OWNER[method]
    schema.check_owner({"jsonrpc": "2.0", "method": method, "params": params})
    decoded = decode_owner_notification(method, raw_of(params))
    assert json.loads(encode(decoded)) == params
    if method != "exchanges":
        assert decode_owner_notification(method, raw_of(with_unknown_fields(params))) == decoded


@pytest.mark.parametrize("method", FROM_OWNER)
def test_a_notification_of_the_owner_with_a_wrong_type_is_refused(method: str) -> None:
    for name, part in FROM_OWNER[method].items():
        with pytest.raises(InvalidParams, match=f"^{method}: {name}"):
            decode_owner_notification(method, raw_of({**FROM_OWNER[method], name: 5.5 if part == "hcp2" else "text"}))


def test_an_event_of_a_later_version_is_ignored_and_one_without_a_name_is_refused() -> None:
    later = {**STREAM, "body": {"event": "Solstice", "depth": 3}}
    assert decode_owner_notification("event", raw_of(later)) is None
    with pytest.raises(InvalidParams, match=r"'body\.event' is missing"):
        decode_owner_notification("event", raw_of({**STREAM, "body": {}}))


def test_the_name_of_an_event_is_that_of_its_type() -> None:
    for kind in get_args(EventForm):
        assert f"{kind.__struct_config__.tag}Form" == kind.__name__


def test_a_reply_of_the_owner_is_decoded_by_the_method_of_its_request() -> None:
    message = decode_owner_message(encode_result(3, {"period": 0.5, "name": "mine"}).decode())
    assert message.id == 3
    assert isinstance(message.result, msgspec.Raw)
    assert decode_result("poll", message.result).name == "mine"
    with pytest.raises(InvalidParams, match="now: expected `float`, got `object`"):
        decode_result("now", message.result)


def test_an_error_keeps_its_fields() -> None:
    refused = Refused("it is not writable", confirm=False, hint="look at its manual")
    refused.temporary = True
    error = decode_owner_message(encode_error_reply(1, encode_error(refused)).decode()).error
    assert not isinstance(error, msgspec.UnsetType)
    again = error_of(error)
    assert isinstance(again, Refused)
    assert (again.what, again.hint, again.confirm, again.temporary) == (refused.what, refused.hint, False, True)
    assert isinstance(error_of(encode_error(InvalidCommand("no"))), InvalidCommand)


# values


def test_numbers_that_json_does_not_have_are_named_wherever_they_are() -> None:
    value = {"a": (inf, -inf), "b": [nan]}
    assert encode_json(value) == '{"a":[{"float":"inf"},{"float":"-inf"}],"b":[{"float":"nan"}]}'
    assert [encode_number(number) for number in (1.5, inf)] == [1.5, NonFinite("inf")]


def test_a_value_of_a_subclass_is_sent_as_its_base() -> None:
    class Volts(float):
        """A number with a unit."""

    assert encode_json([Volts(1.5), Priority.POLL, True]) == "[1.5,2,true]"
    with pytest.raises(TypeError, match="a bytes cannot be sent"):
        encode_value(b"raw")


def test_a_set_is_not_sent_as_a_list() -> None:
    assert encode_json(frozenset({5, 1})) == '{"members":[1,5]}'
    assert value_of({"members": [1, 5]}) == frozenset({1, 5})


def test_a_file_name_that_is_not_utf_8_is_sent_with_a_question_mark() -> None:
    params = WriteParams("a\udcff", "b", {"c\udcfe": ["d\udcfd"]})
    assert json.loads(encode(params)) == {"group": "a?", "key": "b", "value": {"c?": ["d?"]}}


# requests on a line


def test_a_request_with_the_fewest_parameters_has_the_options_of_its_role(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        [client] = line.service.clients
        for options, priority in ((None, client.reads.priority), (OptionsForm(Priority.URGENT), Priority.URGENT)):
            params = RequestParams("hcp2", 5, COMMAND, options=options)
            request = client_request_of(params, client, line.service.line)
            assert isinstance(request, Reading)
            assert request._request.options.priority is priority

    on_a_served_line(tmp_path, story)


def test_a_plain_read_has_no_time_and_one_with_a_limit_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[dict[str, Any]] = []
    send = Connection.send

    def noted(self: Connection, message: bytes) -> None:
        sent.append(json.loads(message))
        send(self, message)

    async def story(line: Served, remote: RemoteBus) -> None:
        controller = Hcp2Controller(remote, 5)
        await controller.read(1)
        monkeypatch.setattr(Connection, "send", noted)
        await controller.read(1)
        await controller.read(1, finish_within=5.0)
        plain, limited = [message["params"] for message in sent if "method" in message]
        assert plain == READ
        assert limited["options"] == {"finish_within": 5.0}
        assert limited["requested"] > 0  # the transfer is a part of its time

    on_a_served_line(tmp_path, story)


def test_a_request_is_refused_if_its_node_was_named_wrongly(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client:
            assert (await client.ask("request", **READ))["result"] == 0
            for wrong in (7, "many"):
                assert "error" in await client.ask("node", **NODE, retries=wrong)
                assert "retries" in (await client.ask("request", **READ))["error"]["message"]
                assert "result" in await client.ask("node", **NODE)
            assert (await client.ask("request", **READ))["result"] == 0

    on_a_line(tmp_path, story)


def test_requests_with_the_same_text_are_each_carried_out_and_a_wrong_one_is_refused_each_time(tmp_path: Path) -> None:
    def write(value: float) -> dict[str, Any]:
        return {**READ, "command": {"command": "write", "element": 1, "values": [value]}}

    async def story(line: Served) -> None:
        async with raw(line) as client:
            for value in (5, 6, 5, -0.0, 0.0):
                assert (await client.ask("request", **write(value)))["result"] is None
                assert (await client.ask("request", **READ))["result"] == value
            for wrong in (True, 1.5, 1000):
                for _ in range(2):
                    refused = await client.ask("request", **READ | {"command": {"command": "read", "element": wrong}})
                    assert refused["error"]["code"] == -32602
            assert (await client.ask("request", **READ))["result"] == 0

    on_a_line(tmp_path, story)


def test_a_long_request_is_not_kept() -> None:
    def decoded(values: int) -> Any:
        params = {"protocol": "hcp2", "address": 5, "command": {"command": "write", "values": [1] * values}}
        return decode_request_params("request", msgspec.Raw(json.dumps(params).encode()))

    assert decoded(1) is decoded(1)
    assert decoded(100) is not decoded(100)
    assert decoded(100).command["values"] == 100 * [1]


def test_a_program_has_a_limited_number_of_requests_and_each_has_its_own_id(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client:
            [owner] = line.service.clients
            read = RequestParams("hcp2", 5, COMMAND)
            for number in range(bounds.MOST_REQUESTS):
                owner.requests.begin(number, read)
            with pytest.raises(Malformed, match="request 0 is already in progress"):
                owner.requests.begin(0, read)
            with pytest.raises(Malformed, match="request 0 is already in progress"):
                owner.take(decode_client_message(encode_request("now", 0, NoParams()).decode()))
            with pytest.raises(Malformed, match="request 0 is already in progress"):
                owner.take(decode_client_message('{"jsonrpc":"2.0","id":0,"method":"now","params":[]}'))
            owner.requests.begin(bounds.MOST_REQUESTS, read)
            assert len(owner.unfinished) == bounds.MOST_REQUESTS
            reply = await client.hear()
            assert (reply["id"], reply["error"]["data"]["error"]) == (bounds.MOST_REQUESTS, BacklogFull.__name__)

    on_a_line(tmp_path, story)


def test_invalid_parameters_are_refused_and_the_connection_stays(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client:
            for params in (list[int](), None, 3, "text"):
                await client.connection.send(json.dumps({"jsonrpc": "2.0", "id": 1, "method": "now", "params": params}))
                assert "now: expected `object`, got" in (await client.hear())["error"]["message"]
            assert "result" in await client.ask("now", later=True)

    on_a_line(tmp_path, story)
