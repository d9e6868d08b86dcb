"""OPC UA clients of three stacks have values again after a cut connection and after programs were restarted."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import re
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import asyncua
import opcua
import pytest
from opcua import ua

from tests.app.cli.conftest import owner, serve, started
from tests.app.interfaces.cutting_proxy import cutting_proxy
from tests.app.interfaces.opcua_client import OtherClient, other_client
from tests.patience import PATIENCE
from tests.ports import free_port

TEXT = """
title = "Slitter"
port = "PORT?baudrate=57600"
[nodes.winder]
protocol = "hcp2"
address = 1
points.force = { item = "10", unit = "N", factor = 0.1 }
[groups.fast]
period = 0.05
points = ["winder/force"]
"""
NODE_CLIENT = Path(__file__).with_name("node_opcua_client.js")


def has_node_opcua() -> bool:
    """Whether `node` finds the module: in NODE_PATH, or above this folder."""
    node = shutil.which("node")
    wanted = "require.resolve('node-opcua')"
    return node is not None and subprocess.run([node, "-e", wanted], capture_output=True, check=False).returncode == 0


class Received:
    """What a subscription has received, in its order, and how often its client sent Republish."""

    def __init__(self) -> None:
        self.values: list[Any] = []
        self.republished = 0
        self.complaints: list[str] = []
        self._news = threading.Condition()

    def add(self, value: Any) -> None:
        with self._news:
            self.values.append(value)
            self._news.notify_all()

    def wait(self, value: float) -> None:
        with self._news:
            found = self._news.wait_for(lambda: value in self.values, PATIENCE)
        assert found, f"{value} was not received, but {self.values[-5:]}; {self.complaints[-5:]}"


@contextmanager
def node_opcua(url: str, name: str) -> Iterator[Received]:
    """node-opcua: its own recovery."""
    received = Received()
    with subprocess.Popen(
        ["node", str(NODE_CLIENT), url, name], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        assert process.stdout is not None
        lines = process.stdout

        def take() -> None:
            for line in lines:
                if not line.startswith("{"):  # the library prints, too
                    received.complaints.append(line)
                    continue
                told = json.loads(line)
                if "sent" in told:
                    received.republished += 1
                elif "error" in told:
                    received.complaints.append(line)
                elif told["status"] == "Good":
                    received.add(told["value"])

        thread = threading.Thread(target=take)
        thread.start()
        try:
            yield received
        finally:
            process.kill()
            process.wait(PATIENCE)
            thread.join(PATIENCE)


@contextmanager
def python_opcua(url: str, name: str) -> Iterator[Received]:
    """python-opcua, which has no recovery: a program that uses it connects and subscribes again after an error."""
    received, end = Received(), threading.Event()

    class Handler:
        def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
            if data.monitored_item.Value.StatusCode.is_good():
                received.add(value)

    def use() -> None:
        while not end.is_set():
            client = opcua.Client(url, timeout=2)
            try:
                client.connect()
                node = OtherClient(client).node(name)
                client.create_subscription(100, Handler()).subscribe_data_change(node)
                while not end.wait(0.1):
                    client.get_node(ua.ObjectIds.Server_ServerStatus_State).get_value()
            except Exception as error:
                received.complaints.append(repr(error))
            with contextlib.suppress(Exception):
                client.disconnect()
            end.wait(0.2)

    thread = threading.Thread(target=use)
    thread.start()
    try:
        yield received
    finally:
        end.set()
        thread.join(PATIENCE)


@contextmanager
def asyncua_client(url: str, name: str) -> Iterator[Received]:
    """asyncua: its own recovery."""
    received = Received()

    class Handler:
        def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
            if data.monitored_item.Value.StatusCode.is_good():
                received.add(value)

    async def use() -> None:
        client = asyncua.Client(url, timeout=2, auto_reconnect=True, reconnect_max_delay=0.5)
        await client.connect()
        subscription = await client.create_subscription(100, Handler())
        await subscription.subscribe_data_change(client.get_node(f"ns=2;s={name}"))
        loops.append(asyncio.get_running_loop())
        ready.set()
        try:
            await end.wait()
        finally:
            with contextlib.suppress(Exception):
                await client.disconnect()

    loops: list[asyncio.AbstractEventLoop] = []
    ready, end = threading.Event(), asyncio.Event()
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)  # it logs each lost connection as an exception
    # `asyncio.run` waits for the tasks of the client: one that is left would fail the test in which it is collected.
    thread = threading.Thread(target=lambda: asyncio.run(use()), daemon=True)
    thread.start()
    try:
        assert ready.wait(PATIENCE)
        yield received
    finally:
        for loop in loops:
            loop.call_soon_threadsafe(end.set)
        thread.join(PATIENCE)
        logging.getLogger("asyncua").setLevel(logging.NOTSET)


class Plant:
    """A line, its owner and its interface, which a test restarts, and a client that writes past the proxy."""

    def __init__(self, file: Path, stack: ExitStack) -> None:
        self._file, self._stack = file, stack
        self._owner = self._interface = ExitStack()
        self.port = free_port()
        self.written = 0.0

    def start_owner(self) -> None:
        self._owner.close()
        self._owner = self._stack.enter_context(ExitStack())
        self._owner.enter_context(owner("serve", str(self._file)))

    def start_interface(self) -> None:
        self._interface.close()
        self._interface = self._stack.enter_context(ExitStack())
        process = started("opcua", "slitter", "--allow", "*", "--bind", f"127.0.0.1:{self.port}")
        self._interface.callback(process.communicate, timeout=PATIENCE)
        self._interface.callback(process.send_signal, signal.SIGKILL)
        assert process.stderr is not None
        said = ""
        while not re.search(r"opc\.tcp://", said):
            line = process.stderr.readline()
            assert line, said
            said += line
        threading.Thread(target=process.stderr.read, daemon=True).start()

    def write(self) -> float:
        """Write a value that was not there before, and return it."""
        self.written += 1.0
        with other_client(f"opc.tcp://127.0.0.1:{self.port}/") as client:
            while client.write("winder/force", self.written) != "Good":
                pass
        return self.written


STACKS: list[Any] = [
    pytest.param(python_opcua, id="python-opcua"),
    pytest.param(asyncua_client, id="asyncua"),
    pytest.param(
        node_opcua,
        id="node-opcua",
        marks=pytest.mark.skipif(not has_node_opcua(), reason="`node` with the module node-opcua is not installed"),
    ),
]


@pytest.mark.slow
@pytest.mark.parametrize("stack", STACKS)
def test_values_come_back_after_a_cut_connection_a_restarted_interface_and_a_restarted_owner(
    stack: Callable[[str, str], contextlib.AbstractContextManager[Received]],
    tmp_path: Path,
) -> None:
    file = tmp_path / "slitter.toml"
    with ExitStack() as leave:
        controllers = leave.enter_context(serve("hcp2", 1))
        file.write_text(TEXT.replace("PORT", controllers.path))
        plant = Plant(file, leave)
        plant.start_owner()
        plant.start_interface()
        proxy = leave.enter_context(cutting_proxy(plant.port))
        received = leave.enter_context(stack(f"opc.tcp://127.0.0.1:{proxy.port}/", "winder/force"))
        received.wait(plant.write())
        for name, event in (
            ("a cut connection", proxy.cut),
            ("a second cut", proxy.cut),
            ("a restarted interface", plant.start_interface),
            ("a restarted owner", plant.start_owner),
        ):
            event()
            began = time.monotonic()
            value = plant.write()
            received.wait(value)
            logging.getLogger(__name__).warning("%s: %.2f s", name, time.monotonic() - began)
        assert received.republished < 50
