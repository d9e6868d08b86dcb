"""`busmaster opcua` as a process of its own: killed, with certificates and users, and what it refuses."""

from __future__ import annotations

import asyncio
import datetime
import re
import signal
import socket
import subprocess
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.x509.oid import NameOID
from opcua import ua

from busmaster.app.interfaces import opcua
from busmaster.app.interfaces.following import Following
from busmaster.app.interfaces.opcua import read_trusted
from busmaster.app.interfaces.opcua_access import Rules
from busmaster.emulator.serve import TcpServer
from busmaster.errors import InvalidCommand
from tests.app.cli.conftest import Command, busmaster, owner, serve, started
from tests.app.interfaces.opcua_client import other_client
from tests.app.service.test_interfaces import has_ipv6
from tests.patience import PATIENCE

__all__ = ["busmaster"]
TOKEN = "0123456789abcdef0123456789abcdef"
TEXT = """
title = "Slitter"
port = "PORT?baudrate=57600"
[nodes.winder]
protocol = "hcp2"
address = 1
points.force = { item = "10", unit = "N", factor = 0.1, minimum = -50, maximum = 50 }
[groups.fast]
period = 0.05
points = ["winder/force"]
"""


@pytest.fixture
def controllers() -> Iterator[TcpServer]:
    with serve("hcp2", 1) as server:
        yield server


@pytest.fixture
def file(tmp_path: Path, controllers: TcpServer) -> Path:
    path = tmp_path / "slitter.toml"
    path.write_text(TEXT.replace("PORT", controllers.path))
    return path


@contextmanager
def interface(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """An interface that follows its line, and where clients find it."""
    with started("opcua", *arguments, "--bind", "127.0.0.1:0") as process:
        assert process.stderr is not None
        try:
            said = ""
            while "connected to line" not in said or not (found := re.search(r"opc\.tcp://\S+", said)):
                line = process.stderr.readline()
                assert line, said
                said += line
            yield process, found[0]
        finally:
            process.kill()
            process.communicate(timeout=PATIENCE)


def certificate(folder: Path, name: str) -> tuple[str, str]:
    """A certificate that has signed itself, and its key: the paths of both."""
    key = rsa.generate_private_key(public_exponent=65537, key_size=2048)
    who = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = datetime.datetime.now(datetime.UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(who)
        .issuer_name(who)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.UniformResourceIdentifier(f"urn:{name}")]), critical=False)
        .sign(key, hashes.SHA256())
    )
    folder.mkdir(exist_ok=True)
    paths = folder / f"{name}.der", folder.parent / f"{name}.pem"
    paths[0].write_bytes(made.public_bytes(serialization.Encoding.DER))
    form, open_ = serialization.PrivateFormat.TraditionalOpenSSL, serialization.NoEncryption()
    paths[1].write_bytes(key.private_bytes(serialization.Encoding.PEM, form, open_))
    return str(paths[0]), str(paths[1])


@pytest.mark.slow
def test_an_interface_that_is_killed_again_and_again_is_nothing_to_the_line(file: Path) -> None:
    with owner("serve", str(file)) as (process, _):
        for _ in range(5):  # more was tried by hand: an interface takes seconds to start
            with interface("slitter") as (killed, _url):
                killed.send_signal(signal.SIGKILL)
        with interface("slitter", "--allow", "winder/*") as (ended, url):
            with other_client(url) as client:
                assert client.write("winder/force", 3.0) == "Good"
                assert client.write("winder/force", 51.0) == "BadOutOfRange"
                assert client.property("winder/force", "EURange").High == 50
            ended.terminate()
            assert ended.wait(PATIENCE) == 143
        assert process.poll() is None


@pytest.mark.slow
def test_with_a_certificate_only_trusted_clients_come_and_users_with_a_token_write(file: Path, tmp_path: Path) -> None:
    server_files, client_files = certificate(tmp_path / "own", "interface"), certificate(tmp_path / "trusted", "client")
    other_files = certificate(tmp_path / "others", "other")
    server_key = Path(server_files[1]).rename(tmp_path / "server.key")  # PEM, whatever its name
    tokens = tmp_path / "tokens"
    tokens.write_text(f"scada {TOKEN}\n")
    tokens.chmod(0o600)
    options = ["--certificate", server_files[0], "--key", str(server_key), "--trusted", str(tmp_path / "trusted")]
    with (
        owner("serve", str(file)),
        interface("slitter", "--allow", "winder/force", "--token-file", str(tokens), *options) as (process, url),
    ):

        def secured(files: tuple[str, str], **more: Any) -> Any:
            return other_client(url, set_security_string=(f"Basic256Sha256,SignAndEncrypt,{','.join(files)}",), **more)

        with secured(client_files) as client:
            while client.read("winder/force").status != "Good":
                pass
            assert client.write("winder/force", 3.0) == "BadUserAccessDenied"
            assert client.user_access("winder/force") == 1  # CurrentRead
        with secured(client_files, set_user=("scada",), set_password=(TOKEN,)) as client:
            assert client.write("winder/force", 3.0) == "Good"
            assert client.user_access("winder/force") == 3  # CurrentRead and CurrentWrite
        for files, more in (
            (client_files, {"set_user": ("scada",), "set_password": ("x" * 32,)}),
            (other_files, {}),
        ):
            with pytest.raises(ua.UaStatusCodeError, match="BadUserAccessDenied"), secured(files, **more):
                pass
        with pytest.raises(ua.UaError), other_client(url):  # nobody is let in who says things openly
            pass
        process.terminate()
        assert process.stderr is not None
        assert "1 failed login at opcua: 1 from 127.0.0.1\n" in process.stderr.read()


@pytest.mark.slow
@pytest.mark.skipif(not has_ipv6(), reason="this machine has no IPv6")
def test_clients_connect_to_an_ipv6_address_as_it_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opcua, "LISTEN_AFTER", 0.0)

    async def story() -> None:
        line = Following(lambda: "unix:/nobody")
        async with opcua.serving(line, Rules(), ("::1", 0), lambda _: None) as url:
            assert url.startswith("opc.tcp://[::1]:")
            entered = other_client(url)
            client = await asyncio.to_thread(entered.__enter__)
            assert (await asyncio.to_thread(client.read, "Line Connected")).value is False
            await asyncio.to_thread(entered.__exit__, None, None, None)

    asyncio.run(story())


def test_a_port_that_is_in_use_leaves_no_task_and_no_thread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded: list[tuple[str, str]] = []
    load = opcua.load_certificate

    async def load_certificate(server: Any, own: str, key: str) -> None:
        await load(server, own, key)
        loaded.append((own, key))

    async def story(address: tuple[str, int]) -> None:
        tasks, line = asyncio.all_tasks(), Following(lambda: "unix:/nobody")
        with pytest.raises(OSError, match="in use"):
            async with opcua.serving(line, Rules(), address, lambda _: None, certificate=files):
                pass
        assert asyncio.all_tasks() == tasks

    monkeypatch.setattr(opcua, "load_certificate", load_certificate)
    files = certificate(tmp_path / "own", "interface")
    threads = set(threading.enumerate())
    with socket.create_server(("127.0.0.1", 0)) as taken:
        asyncio.run(story(taken.getsockname()))
    assert set(threading.enumerate()) == threads
    assert loaded == [files]


def test_a_line_is_served_with_what_the_command_gives_until_it_is_cancelled(monkeypatch: pytest.MonkeyPatch) -> None:
    served: list[tuple[Any, ...]] = []
    urls: list[str] = []

    @asynccontextmanager
    async def serving(*what: Any, certificate: tuple[str, str] | None) -> AsyncIterator[str]:
        served.append((*what, certificate))
        yield "opc.tcp://127.0.0.1:4840/"
        served.append(())

    async def story() -> None:
        what: Any = ("line", "rules", ("127.0.0.1", 0), urls.append, "report", ("own", "key"))
        task = asyncio.ensure_future(opcua.serve(*what))
        for _ in range(5):
            await asyncio.sleep(0)
        assert served == [("line", "rules", ("127.0.0.1", 0), "report", ("own", "key"))]
        assert urls == ["opc.tcp://127.0.0.1:4840/"]
        assert not task.done()
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    monkeypatch.setattr(opcua, "serving", serving)
    asyncio.run(story())


def read_certificate(path: str) -> x509.Certificate:
    return x509.load_der_x509_certificate(Path(path).read_bytes())


class WithCertificate:
    """A server, as far as its certificate."""

    def __init__(self) -> None:
        self.iserver: Any = SimpleNamespace(certificate=None)
        self.formats: list[str] = []
        self.uris: list[str] = []

    async def load_certificate(self, path: str, format_: str) -> None:
        self.formats.append(format_)
        self.iserver.certificate = read_certificate(path)

    async def load_private_key(self, _path: str, *, format: str) -> None:  # noqa: A002  the name in the library
        self.formats.append(format)

    async def set_application_uri(self, uri: str) -> None:
        self.uris.append(uri)


def test_a_server_has_the_name_that_its_certificate_has(tmp_path: Path) -> None:
    server: Any = WithCertificate()
    asyncio.run(opcua.load_certificate(server, *certificate(tmp_path / "own", "interface")))
    assert server.uris == ["urn:interface"]
    assert server.formats == ["der", "pem"]


def test_files_that_are_no_certificate_and_key_are_named(tmp_path: Path) -> None:
    own, key = certificate(tmp_path / "own", "interface")

    async def fail(*_: object, **__: object) -> None:
        raise TypeError("it is of another kind")

    server: Any = WithCertificate()
    server.load_private_key = fail
    with pytest.raises(InvalidCommand, match=rf"^{own} and {key} are not a certificate and its key: it is of another"):
        asyncio.run(opcua.load_certificate(server, own, key))
    with pytest.raises(InvalidCommand, match=rf"^{key} and {key} are not a certificate and its key"):
        asyncio.run(opcua.load_certificate(cast("Any", WithCertificate()), key, key))


def test_every_certificate_in_the_folder_is_trusted(tmp_path: Path) -> None:
    folder = tmp_path / "trusted"
    for name in ("first", "second"):
        certificate(folder, name)
    trusted = read_trusted(str(folder))
    assert len(trusted) == 2
    both = tmp_path / "both"
    both.mkdir()
    for number, der in enumerate(trusted):  # in the other form, under any name
        pem = x509.load_der_x509_certificate(der).public_bytes(serialization.Encoding.PEM)
        (folder / f"{number}").write_bytes(pem)
        with (both / "both.pem").open("ab") as file:
            file.write(pem)
    assert read_trusted(str(folder)) == trusted
    assert read_trusted(str(both)) == trusted


def test_a_folder_without_a_certificate_or_with_something_else_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidCommand, match="has no certificate, so no client could connect"):
        read_trusted(str(tmp_path))
    for content in (b"a note", b"-----BEGIN CERTIFICATE-----"):
        (tmp_path / "note").write_bytes(content)
        with pytest.raises(InvalidCommand, match=r"note is not a certificate; .* is for those of trusted clients"):
            read_trusted(str(tmp_path))


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--read-only", "--allow", "*"), "--allow and --read-only exclude each other"),
        (("--bind", "0.0.0.0:0", "--allow", "*"), "needs --token-file"),
        (("--certificate", __file__), "need each other"),
        (("--trusted", "."), "--trusted needs --certificate"),
        (("--bind", "here"), "--bind: a TCP address is written HOST:PORT"),
    ],
)
def test_what_would_open_more_than_is_meant_is_wrong_usage(
    busmaster: Command,
    arguments: tuple[str, ...],
    complaint: str,
) -> None:
    ran = busmaster("opcua", "slitter", *arguments)
    assert ran.status == 2
    assert complaint in ran.err


LINE = ("opcua", "unix:/nobody")


class Served:
    """What the last command served, and where."""

    def __init__(self) -> None:
        self.line: Any = None
        self.rules = Rules()
        self.listen = ("", 0)
        self.certificate: tuple[str, str] | None = None


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> Served:
    """Nothing is served."""
    last = Served()

    async def serve(
        line: Any, rules: Rules, listen: tuple[str, int], opened: Any, report: Any, certificate: tuple[str, str] | None
    ) -> None:
        last.line, last.rules, last.listen, last.certificate = line, rules, listen, certificate
        opened("opc.tcp://127.0.0.1:4840/")

    monkeypatch.setattr(opcua, "serve", serve)
    return last


def test_by_default_points_are_only_read_by_programs_of_this_machine(busmaster: Command, served: Served) -> None:
    ran = busmaster(*LINE)
    assert (ran.status, ran.err) == (0, "busmaster: serving OPC UA at opc.tcp://127.0.0.1:4840/\n")
    assert (served.listen, served.rules, served.certificate) == (("127.0.0.1", 4840), Rules(), None)
    assert served.line.read_only is False
    assert busmaster(*LINE, "--read-only").status == 0
    assert served.line.read_only is True


def test_each_option_reaches_the_rules_and_the_server(busmaster: Command, served: Served, tmp_path: Path) -> None:
    tokens, trusted = tmp_path / "tokens", tmp_path / "trusted"
    tokens.write_text(f"scada {TOKEN}\nhmi {TOKEN[::-1]}\n")
    tokens.chmod(0o600)
    own, key = certificate(trusted, "client")
    options = (
        *("--allow", "winder/*", "--allow", "oven/set", "--token-file", str(tokens), "--bind", "0.0.0.0:4841"),
        *("--certificate", own, "--key", key, "--trusted", str(trusted)),
    )
    assert busmaster(*LINE, *options).status == 0
    assert (served.listen, served.certificate) == (("0.0.0.0", 4841), (own, key))
    assert served.rules.allow == ("winder/*", "oven/set")
    assert set(served.rules.secrets) == {"scada", "hmi"}
    assert served.rules.trusted == read_trusted(str(trusted))
    assert (served.rules.is_signed, served.rules.is_local) == (True, False)


def test_messages_are_signed_with_a_certificate_whether_or_not_the_clients_are_named(
    busmaster: Command, served: Served, tmp_path: Path
) -> None:
    own, key = certificate(tmp_path / "own", "server")
    assert busmaster(*LINE, "--certificate", own, "--key", key).status == 0
    assert (served.rules.is_signed, served.rules.trusted) == (True, None)
    assert busmaster(*LINE).status == 0
    assert (served.rules.is_signed, served.rules.trusted) == (False, None)


def test_a_key_without_a_certificate_is_wrong_usage(busmaster: Command, served: Served) -> None:
    ran = busmaster(*LINE, "--key", __file__)
    assert (ran.status, served.line) == (2, None)
    assert "--certificate and --key need each other; give both" in ran.err


@pytest.mark.parametrize("missing", ["asyncua", "msgspec", "websockets"])
def test_a_missing_library_is_named_with_its_extra(
    busmaster: Command, monkeypatch: pytest.MonkeyPatch, missing: str
) -> None:
    monkeypatch.setattr("busmaster.app.cli.opcua.find_spec", lambda name: None if name == missing else object())
    ran = busmaster(*LINE)
    assert ran.status == 2
    assert "pip install 'busmaster[opcua]'" in ran.err
