"""MQTT over an encrypted connection, to a real broker."""

from __future__ import annotations

import gc
import json
import socket
import ssl
import threading
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from ipaddress import IPv4Address
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from busmaster.app.outputs.mqtt_connection import unread
from busmaster.protocols.hcp2.handle import Hcp2Controller
from tests.app.outputs.brokers import Broker, needs_mosquitto, running
from tests.app.outputs.cycles import cycle, until
from tests.app.outputs.test_mqtt import emulated, heard, listening, publishing

pytestmark = needs_mosquitto
pytest.importorskip("cryptography")


def certificate(file: Path) -> Path:
    """Write a certificate of this machine, signed by itself, and its key."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "broker")])
    now = datetime.now(UTC)
    made = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(IPv4Address("127.0.0.1"))]), critical=False)
        .sign(key, hashes.SHA256())
    )
    pem = serialization.Encoding.PEM
    secret = key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    file.write_bytes(made.public_bytes(pem) + secret)
    return file


@pytest.fixture(scope="module")
def trusted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return certificate(tmp_path_factory.mktemp("trusted") / "broker.pem")


@pytest.fixture(scope="module")
def broker(trusted: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    with running(tmp_path_factory.mktemp("broker"), trusted) as found:
        yield found


@pytest.mark.asyncio
async def test_values_are_published_and_commands_are_obeyed(broker: Broker, trusted: Path) -> None:
    context = ssl.create_default_context(cafile=str(trusted))
    bus = emulated(Hcp2Controller, 5)
    controller = Hcp2Controller(bus, 5)
    options: dict[str, Any] = {"tls": True, "ca_file": str(trusted), "commands": {"5/1": controller.point("1")}}
    async with bus, listening(broker, "line/values/#", "line/result/#", tls_context=context) as client:
        async with publishing(broker, bus, **options) as output:
            output.offer(cycle(1, 12.5))
            [(topic, payload, _)] = await heard(client, 1)
            assert (topic, payload["value"]) == ("line/values/5/1", 12.5)
            await client.publish("line/set/5/1", json.dumps({"value": 3.5, "id": "a"}), qos=1)
            [(topic, answer, _)] = await heard(client, 1)
            assert (topic, answer) == ("line/result/5/1", {"ok": True, "id": "a"})
        assert await controller.read(1) == 3.5


# paho-mqtt leaves the socket of a failed handshake to the garbage collection
@pytest.mark.filterwarnings("ignore:Exception ignored in. <ssl.SSLSocket:pytest.PytestUnraisableExceptionWarning")
@pytest.mark.slow
@pytest.mark.asyncio
@pytest.mark.parametrize("tls", [True, False])
async def test_a_broker_without_a_trusted_certificate_gets_nothing_and_this_is_reported(
    broker: Broker, tmp_path: Path, tls: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busmaster.app.outputs.mqtt.TIMEOUT", 1.0)  # for which a broker waits for a handshake
    other = certificate(tmp_path / "other.pem")
    async with publishing(broker, tls=tls, ca_file=str(other) if tls else None) as output:
        output.offer(cycle(1, 12.5))
        until(lambda: output.statistics().error != "")
        counts = output.statistics()
    assert (counts.written, counts.waiting) == (0, 1)
    assert not tls or "certificate" in counts.error
    gc.collect()  # here, and not in another test, which would fail


def test_decrypted_bytes_that_are_not_read_yet_are_counted(trusted: Path) -> None:
    """A message that lies in them has come: its command is as old as the last look."""
    of_broker = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    of_broker.load_cert_chain(trusted)
    here, there = socket.socketpair()

    def serve() -> None:
        with of_broker.wrap_socket(there, server_side=True) as connection:
            connection.sendall(bytes(1000))
            connection.recv(1)

    thread = threading.Thread(target=serve)
    thread.start()
    context = ssl.create_default_context(cafile=str(trusted))
    with context.wrap_socket(here, server_hostname="127.0.0.1") as connection:
        assert connection.recv(1) == b"\0"
        client = SimpleNamespace(_client=SimpleNamespace(socket=lambda: connection))
        assert unread(cast("Any", client)) >= 999
        connection.send(b"\0")
    thread.join()
