"""`busmaster web` behind a TLS proxy with a name, and with more connections than it has descriptors."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import re
import resource
import shutil
import socket
import ssl
import subprocess
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from tests.app.cli.conftest import ROOT, Command, owner
from tests.app.cli.test_web import until_said, web
from tests.patience import PATIENCE
from tests.ports import free_port

TOKEN = "0123456789abcdef"
NAME = "plant.example"
ONE = "/api/points/fast/winder/force"


def certificate(folder: Path) -> None:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, NAME)])
    now = datetime.now(UTC)
    made = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName(NAME)]), critical=False)
        .sign(key, hashes.SHA256())
    )
    (folder / "plant.pem").write_bytes(made.public_bytes(serialization.Encoding.PEM))
    (folder / "plant.key").write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )


def documented() -> str:
    """The configuration of nginx that the page shows."""
    [text] = re.findall(r"```text\n(map \$http_upgrade.*?)```", (ROOT / "docs/interfaces.md").read_text(), re.DOTALL)
    return str(text)


@contextlib.contextmanager
def nginx(folder: Path, behind: str) -> Iterator[int]:
    """A real one, as the page configures it, on a port of its own."""
    program = shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin")
    if program is None:
        pytest.skip("nginx is not installed")
    certificate(folder)
    port = free_port()
    server = documented()
    for before, after in (
        ("listen 443", f"listen 127.0.0.1:{port}"),
        ("http://127.0.0.1:8420", behind.rstrip("/")),
        ("/etc/ssl/", f"{folder}/"),
    ):
        assert before in server
        server = server.replace(before, after)
    paths = "".join(
        f"{kind}_temp_path {folder}/{kind};\n" for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    (folder / "nginx.conf").write_text(
        f"daemon off;\nmaster_process off;\npid {folder}/nginx.pid;\nerror_log stderr;\nevents {{}}\n"
        f"http {{\naccess_log off;\n{paths}{server}}}\n"
    )
    command = [program, "-p", str(folder), "-c", str(folder / "nginx.conf")]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            while True:
                assert process.poll() is None, process.stderr.read() if process.stderr else ""
                with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port)):
                    break
            yield port
        finally:
            process.kill()


class Asker:
    """Asks at a port of this machine as a browser does that has found it by name."""

    def __init__(self, folder: Path, port: int, name: str = NAME) -> None:
        self.context = ssl.create_default_context(cafile=str(folder / "plant.pem"))
        self.port = port
        self.host = f"{name}:{port}"
        self.origin = f"https://{self.host}"

    def ask(self, method: str, path: str, body: Any = None, **headers: str) -> tuple[int, bytes]:
        raw = socket.create_connection(("127.0.0.1", self.port), timeout=PATIENCE)
        with contextlib.closing(http.client.HTTPConnection(self.host, timeout=PATIENCE)) as connection:
            connection.sock = self.context.wrap_socket(raw, server_hostname=NAME)
            headers = {"Content-Type": "application/json", "Origin": self.origin, **headers}
            connection.request(method, path, None if body is None else json.dumps(body), headers)
            answer = connection.getresponse()
            return answer.status, answer.read()

    def stream(self, **options: Any) -> Any:
        return connect(
            f"wss://{self.host}/api/stream", ssl=self.context, server_hostname=NAME, host="127.0.0.1", port=self.port,
            proxy=None, **{"origin": self.origin, **options},
        )  # fmt: skip


@pytest.mark.slow
def test_behind_a_tls_proxy_the_page_its_stream_and_its_writes_work_under_its_name(file: Path, tmp_path: Path) -> None:
    tokens = tmp_path / "tokens"
    tokens.write_text(f"hmi {TOKEN}\n")
    tokens.chmod(0o600)
    options = ("--host", "other.example", "--host", "Plant.Example", "--token-file", str(tokens))
    with owner("serve", str(file)) as (_, address), web(address, *options) as (interface, client):
        until_said(interface, "connected to line")
        with nginx(tmp_path, str(client.base_url)) as port:
            asker = Asker(tmp_path, port)
            status, text = asker.ask("GET", "/")
            assert (status, b"<!doctype html>" in text.lower()) == (200, True)
            assert json.loads(asker.ask("GET", "/api/line")[1])["connected"] is True
            assert asker.ask("PUT", ONE, {"value": 1.5})[0] == 401
            assert asker.ask("PUT", ONE, {"value": 1.5}, Authorization=f"Bearer {TOKEN}")[0] == 200
            assert asker.ask("GET", "/", Origin="https://elsewhere.example")[0] == 403
            assert Asker(tmp_path, port, "elsewhere.example").ask("GET", "/")[0] == 403

            async def follow() -> list[Any]:
                with pytest.raises(InvalidStatus, match="403"):
                    async with asyncio.timeout(PATIENCE), asker.stream(origin="https://elsewhere.example"):
                        pass
                async with asyncio.timeout(PATIENCE), asker.stream() as socket:
                    return [json.loads(await socket.recv()) for _ in range(3)]

            assert len(asyncio.run(follow())) == 3


@pytest.mark.slow
def test_with_a_name_of_a_proxy_nobody_writes_without_a_token(file: Path) -> None:
    with owner("serve", str(file)) as (_, address), web(address, "--host", NAME) as (interface, client):
        until_said(interface, "connected to line")
        answer = client.put(ONE, json={"value": 1.5})
        assert (answer.status_code, "needs a token" in answer.json()["what"]) == (403, True)
        assert client.get("/api/line").json()["read_only"] is True
        assert client.get("/", headers={"Host": NAME}).status_code == 200
        refused = client.get("/", headers={"Host": "elsewhere.example"})
        assert refused.status_code == 403
        assert "of a proxy, name it with --host" in refused.text


@pytest.mark.parametrize("name", ["https://plant.example", "plant.example:443", "", "*.example", "a b"])
def test_a_name_that_cannot_be_one_is_wrong_usage(busmaster: Command, name: str) -> None:
    ran = busmaster("web", "--host", name)
    assert ran.status == 2
    assert "--host" in ran.err


@pytest.mark.slow
def test_idle_connections_beyond_the_descriptors_of_the_process_keep_nobody_out(file: Path) -> None:
    """1200 of them kept the page dead."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with owner("serve", str(file)) as (_, address), contextlib.ExitStack() as ends:
        resource.setrlimit(resource.RLIMIT_NOFILE, (256, hard))  # as the command inherits it
        try:
            interface, client = ends.enter_context(web(address))
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        until_said(interface, "connected to line")
        place = (client.base_url.host, client.base_url.port or 0)
        for _ in range(400):
            ends.enter_context(socket.create_connection(place, PATIENCE))
        assert client.get("/api/line").status_code == 200
        assert "there are 128 connections to the page, and no more are held" in until_said(interface, "connections")
