"""Pictures of lines that are not there, as their owner would say them."""

from __future__ import annotations

from typing import Any

from busmaster.app.service.picture import Picture

FRAME: dict[str, Any] = {
    "set": 1,
    "title": "busmaster poll",
    "line": "/dev/ttyUSB0",
    "settings": "57600 8N1",
    "read_only": False,
    "now": 1061.0,
    "elapsed": 61.0,
    "state": "ready",
    "utilisation": 0.53,
    "backlog": 2,
    "losses": 0,
    "left_out": 0,
    "events": [[1003.1, "node 9 is down, was suspect"]],
}
GROUP: dict[str, Any] = {
    "name": "axes",
    "period": 0.2,
    "cycles": 61,
    "missed": 1,
    "achieved": 0.2,
    "jitter": 0.0011,
    "paused": False,
}


def row(node: int = 5, item: str = "outputs", value: Any = 0, **said: Any) -> tuple[dict[str, Any], list[Any] | None]:
    """A point and what it holds: `quality`, `asked`, `error` and `alarm` are of that, the rest is of the point."""
    held = [value, said.pop("quality", "good"), said.pop("asked", 1060.9), said.pop("error", ""), said.pop("alarm", "")]
    point = {
        "group": "axes",
        "key": f"{node}/{item}",
        "node": f"node {node}",
        "protocol": "hcp2",
        "kind": "hcp2",
        "address": node,
        "item": item,
        "unit": "",
        "precision": None,
        "writable": True,
    }
    return point | said, held


def node(number: int, health: str = "up", **said: Any) -> dict[str, Any]:
    known = {"label": f"node {number}", "protocol": "hcp2", "kind": "hcp2", "address": number, "health": health}
    return known | {"requests": 10, "failed": 0, "late": 0, "p50": 0.0031, "p99": 0.004} | said


def three_drives() -> tuple[tuple[dict[str, Any], list[Any] | None], ...]:
    """Two that answer and one that does not."""
    axes = [row(number, "axis0.position", number + 0.5, unit="mm") for number in (1, 2)]
    return *axes, row(9, "axis0.position", None, unit="mm", quality="bad", asked=1060.9, error="no reply within 100 ms")


def tell(
    picture: Picture,
    *rows: tuple[dict[str, Any], list[Any] | None],
    nodes: tuple[dict[str, Any], ...] = (),
    groups: tuple[dict[str, Any], ...] = (GROUP,),
    **frame: Any,
) -> Picture:
    """Say a whole picture, in the order in which the owner does."""
    number = frame.get("set", FRAME["set"])
    known = nodes or tuple(node(address) for address in dict.fromkeys(point["address"] for point, _ in rows))
    picture.receive("rows", {"set": number, "first": 0, "rows": [point for point, _ in rows]})
    picture.receive("values", {"set": number, "first": 0, "values": [held for _, held in rows]})
    picture.receive("groups", {"first": 0, "groups": list(groups)})
    picture.receive("nodes", {"first": 0, "nodes": list(known)})
    said = {"groups": len(groups), "nodes": len(known), "points": len(rows)}
    picture.receive("frame", {**FRAME, **said, **frame})
    return picture
