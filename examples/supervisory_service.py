"""A supervisory service: HTTP and a websocket for a line. The bus runs as long as the application.

    python examples/supervisory_service.py          on an emulated line: requests each URL once, and ends
    python examples/supervisory_service.py PORT     serves nodes 1 to 4 of a real line on http://127.0.0.1:8000

    GET /health                             state of the line and of its nodes
    GET /nodes/2/axis0.position             a value, now
    PUT /nodes/2/1         {"value": 5}     write one
    websocket /stream                       all positions, one message per cycle

Needs `pip install 'busmaster[examples]'`: starlette; uvicorn to serve, httpx2 for its own requests.
"""

import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

try:
    from starlette.applications import Starlette
except ModuleNotFoundError:
    sys.exit("this example needs starlette: pip install 'busmaster[examples]'")
from starlette.requests import Request
from starlette.responses import JSONResponse
from starlette.routing import Route, WebSocketRoute
from starlette.testclient import TestClient
from starlette.websockets import WebSocket, WebSocketDisconnect

from busmaster import Bus, BusError, Endpoint, Hcp2Controller, InvalidCommand, MemoryPort, Point, Refused, endpoint
from busmaster.emulator.line import Line
from busmaster.registry import make_device

NODES = range(1, 5)


def application(port: Endpoint) -> Starlette:
    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[dict[str, Any]]:
        async with Bus(port) as bus:
            controllers = {node: Hcp2Controller(bus, node) for node in NODES}
            positions = [controller.axis(0).position for controller in controllers.values()]
            group = bus.poll_group("positions", period=0.1, points=positions)
            yield {"bus": bus, "controllers": controllers, "group": group}

    return Starlette(
        routes=[
            Route("/health", health),
            Route("/nodes/{node:int}/{item}", read, methods=["GET"]),
            Route("/nodes/{node:int}/{item}", write, methods=["PUT"]),
            WebSocketRoute("/stream", stream),
        ],
        exception_handlers={ValueError: explain, BusError: explain},
        lifespan=lifespan,
    )


async def health(request: Request) -> JSONResponse:
    bus: Bus = request.state.bus
    nodes = {node.label: node.health.value for node in bus.nodes}
    return JSONResponse(
        {"line": bus.state.name.lower(), "in use": round((await bus.statistics()).utilisation, 3), "nodes": nodes}
    )


async def read(request: Request) -> JSONResponse:
    """A sample of the poll group will do if it is younger than 0.2 s."""
    return JSONResponse({"value": await point(request).read(max_age=0.2)})


async def write(request: Request) -> JSONResponse:
    match await request.json():
        case {"value": int() | float() as value}:
            await point(request).write(value)
            return JSONResponse({"ok": True})
    raise InvalidCommand('the body is {"value": NUMBER}')


async def stream(socket: WebSocket) -> None:
    """A consumer that is too slow loses the oldest; neither the line nor the other consumers wait for it."""
    await socket.accept()
    consumer = socket.state.group.subscribe(buffer=4)
    try:
        async for snapshot in consumer:
            await socket.send_json({point.key: sample.value for point, sample in snapshot.items()})
    except WebSocketDisconnect:
        pass
    finally:
        consumer.close()


def point(request: Request) -> Point[Any]:
    controllers: dict[int, Hcp2Controller] = request.state.controllers
    node = request.path_params["node"]
    if node not in controllers:
        raise InvalidCommand(f"there is no node {node}")
    return controllers[node].point(request.path_params["item"])


def explain(_: Request, error: Exception) -> JSONResponse:
    """Return an error with its cause and its hint."""
    match error:
        case ValueError():  # InvalidCommand, or a body that is not JSON
            status = 400
        case Refused():
            status = 409
        case _:
            status = 503
    return JSONResponse({"error": str(error)}, status)


def check_itself(port: Endpoint) -> None:
    with TestClient(application(port)) as client:
        print(client.put("/nodes/2/1", json={"value": 5}).json(), client.get("/nodes/2/1").json())
        with client.websocket_connect("/stream") as socket:
            print(socket.receive_json())
        for path in ("/nodes/2/axis9.position", "/nodes/9/1", "/health"):
            answer = client.get(path)
            print(answer.status_code, answer.json())


if __name__ == "__main__":
    settings = Hcp2Controller.profile.line
    if sys.argv[1:]:
        import uvicorn

        uvicorn.run(application(endpoint(sys.argv[1], defaults=settings)))
    else:
        check_itself(MemoryPort(Line(settings, [make_device("hcp2", node, lively=True) for node in NODES])))
