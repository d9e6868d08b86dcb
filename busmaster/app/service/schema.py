"""docs/service.schema.json, made from the tables of messages. `python -m tests.docs.reference` writes the file."""

from __future__ import annotations

from typing import Any

from busmaster.app.service.fields import REPLY_TIMES_SCHEMA, VALUE_SCHEMA, BusErrorData, InvalidCommandData, NonFinite
from busmaster.app.service.messages import CLIENT_NOTIFICATIONS, OWNER_NOTIFICATIONS, REQUESTS, VERSIONS
from busmaster.app.service.owner_messages import ErrorForm, ExchangeForm, UnexpectedBytes

REFERENCE = "#/$defs/"
ID = {"type": "integer", "description": "A number of the client's own."}


def service_schema() -> dict[str, Any]:
    """Return the JSON Schema of all messages.

    It is stricter than the receivers, which ignore fields that it does not have: a test of a sender finds them.
    """
    from msgspec.json import schema_components

    named: dict[str, Any] = {}
    for method, types in REQUESTS.items():
        named |= {f"{method}_params": types.params, f"{method}_result": types.result}
    named |= {f"{method}_from_client": params for method, params in CLIENT_NOTIFICATIONS.items()}
    named |= {f"{method}_from_owner": params for method, params in OWNER_NOTIFICATIONS.items()}
    further = (BusErrorData, InvalidCommandData, NonFinite, ExchangeForm, UnexpectedBytes)
    schemas, components = schema_components([*named.values(), ErrorForm, *further], ref_template=REFERENCE + "{name}")
    for component in components.values():
        _close(component)
    components["ReplyTimesForm"] |= REPLY_TIMES_SCHEMA
    # the point of a client, which can omit the names
    components["PolledPoint"] = {**components["PointForm"], "title": "PolledPoint"}
    for name in ("GatherParams", "PollParams"):
        components[name]["properties"]["points"]["items"] = {"$ref": f"{REFERENCE}PolledPoint"}
    components["PointForm"]["required"] = list(components["PointForm"]["properties"])
    error = schemas[len(named)]
    definitions = {
        "client_message": {
            "oneOf": [
                *(_message(method, f"{method}_params", {"id": ID}) for method in REQUESTS),
                *(_message(method, f"{method}_from_client") for method in CLIENT_NOTIFICATIONS),
            ]
        },
        "owner_message": {
            "oneOf": [
                _object({"jsonrpc": {"const": "2.0"}, "id": ID, "result": True}),
                _object({"jsonrpc": {"const": "2.0"}, "id": {"anyOf": [{"type": "null"}, ID]}, "error": error}),
                *(_message(method, f"{method}_from_owner") for method in OWNER_NOTIFICATIONS),
            ]
        },
        **dict(zip(named, schemas, strict=False)),
        "Value": VALUE_SCHEMA,
        **components,
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"The messages between the program that owns a line and its clients, version {VERSIONS[-1]}",
        "description": "One JSON-RPC 2.0 message in each text frame of a WebSocket. METHOD_params and METHOD_result "
        "are the parameters and the result of a request, METHOD_from_client and METHOD_from_owner those of a "
        "notification. Receivers ignore unknown fields.",
        "anyOf": [{"$ref": f"{REFERENCE}client_message"}, {"$ref": f"{REFERENCE}owner_message"}],
        "$defs": definitions,
    }


def _message(method: str, params: str, more: dict[str, Any] | None = None) -> dict[str, Any]:
    fields = {"jsonrpc": {"const": "2.0"}, **(more or {}), "method": {"const": method}}
    return _object({**fields, "params": {"$ref": REFERENCE + params}})


def _object(fields: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": fields, "required": list(fields), "additionalProperties": False}


def _close(component: dict[str, Any]) -> None:
    """Have the schema of a structure permit only the fields that it has."""
    if component.get("type") == "object":
        component["additionalProperties"] = False
    elif component.get("type") == "array":
        component["items"] = False
