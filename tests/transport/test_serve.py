"""A line served in real time. These tests use the wall clock, and ask of it only what a busy machine can keep."""

import errno
import fcntl
import os
import select
import socket
import termios
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from busmaster.contract.profile import LineSettings
from busmaster.emulator import port_settings
from busmaster.emulator.device import Delay
from busmaster.emulator.line import Line
from busmaster.emulator.serve import LineServer, TcpServer, serve_pty, serve_tcp
from busmaster.protocols._comms.mint import EmulatedMint
from tests.patience import PATIENCE
from tests.ports import free_port

WRITE = bytes.fromhex("07 30 32 02 30 31 31 32 33 2E 34 35 36 03 2B")  # AN00129: node 2, Comms(1) = 123.456
READ = bytes.fromhex("07 30 32 02 30 31 05 04")
REPLY = bytes.fromhex("02 30 31 31 32 33 2E 34 35 36 03 2B")
REPLY_ZERO = bytes.fromhex("02 30 31 30 03 32")


def mint_line(paced: bool = False, delay: float = 0.0) -> Line:
    return Line(LineSettings(57600), [EmulatedMint(2, delay=Delay(delay))], paced=paced)


def ask(port: int, request: bytes, length: int, seconds: float = PATIENCE) -> bytes:
    """Writes to an open descriptor and waits for `length` bytes."""
    os.write(port, request)
    end = time.monotonic() + seconds
    got = b""
    while len(got) < length and select.select([port], [], [], max(0.0, end - time.monotonic()))[0]:
        got += os.read(port, 100)
    return got


def until(true: Callable[[], bool]) -> None:
    """Waits until it is true."""
    end = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < end
        time.sleep(0.01)


def opened(path: str) -> int:
    return os.open(path, os.O_RDWR | os.O_NOCTTY)


def connected(server: TcpServer) -> socket.socket:
    return socket.create_connection((server.host, server.port))


def test_a_pty_answers_as_the_device_does_and_is_raw() -> None:
    with serve_pty(mint_line()) as server:
        port = opened(server.path)
        assert ask(port, WRITE, 1) == b"\x06"
        assert ask(port, READ, len(REPLY)) == REPLY
        assert not termios.tcgetattr(port)[3] & (termios.ECHO | termios.ICANON | termios.ISIG)
        os.close(port)


def test_a_pty_answers_where_the_kernel_does_not_tell_how_it_is_set(monkeypatch: pytest.MonkeyPatch) -> None:
    really = fcntl.ioctl

    def ioctl(port: int, request: int, *rest: Any) -> Any:
        if request in (port_settings.GET, port_settings.SET):
            raise OSError(errno.ENOTTY, "not supported")
        return really(port, request, *rest)

    monkeypatch.setattr(fcntl, "ioctl", ioctl)
    with serve_pty(mint_line()) as server:
        port = opened(server.path)
        assert ask(port, WRITE, 1) == b"\x06"
        os.close(port)


def set_rate(port: int, rate: int) -> None:
    settings = termios.tcgetattr(port)
    settings[4] = settings[5] = rate
    termios.tcsetattr(port, termios.TCSANOW, settings)


def test_each_other_baud_rate_of_a_client_is_reported_once() -> None:
    reports: list[str] = []
    with serve_pty(mint_line(), report=reports.append) as server:
        port = opened(server.path)
        for rate, reported in ((termios.B9600, 1), (termios.B9600, 1), (termios.B19200, 2)):
            assert ask(port, WRITE, 1)[-1:] == b"\x06"
            set_rate(port, rate)
            for _ in range(3):
                ask(port, WRITE, 1, 0.1)
            until(lambda wanted=reported: len(reports) == wanted)  # type: ignore[misc]
            set_rate(port, termios.B57600)
        os.close(port)
    assert [report.partition(": ")[2].partition(":")[0] for report in reports] == [
        "the other side sends with 9600 baud, but the emulated line has 57600 baud",
        "the other side sends with 19200 baud, but the emulated line has 57600 baud",
    ]
    assert all(report.startswith(server.path) for report in reports)
    assert "Set the other side to 57600 baud, or emulate a line with 9600 baud" in reports[0]


def test_another_baud_rate_is_logged_by_default(caplog: pytest.LogCaptureFixture) -> None:
    with serve_pty(mint_line()) as server:
        port = opened(server.path)
        set_rate(port, termios.B9600)
        os.write(port, READ)
        until(lambda: "9600 baud" in caplog.text)
        os.close(port)


def test_a_client_may_close_the_pty_and_open_it_again() -> None:
    with serve_pty(mint_line()) as server:
        for _ in range(3):
            port = opened(server.path)
            assert ask(port, WRITE, 1) == b"\x06"
            os.close(port)


def test_a_link_names_the_pty_and_goes_with_it(tmp_path: Path) -> None:
    link = tmp_path / "line"
    with serve_pty(mint_line(), link) as server:
        assert server.path == str(link)
        port = opened(server.path)
        assert ask(port, WRITE, 1) == b"\x06"
        os.close(port)
    assert not os.path.lexists(link)


def test_a_stale_link_is_replaced_but_a_file_is_not(tmp_path: Path) -> None:
    link = tmp_path / "line"
    link.symlink_to(tmp_path / "gone")
    with serve_pty(mint_line(), link):
        assert os.readlink(link).startswith("/dev/")
    link.write_text("mine")
    with pytest.raises(FileExistsError):
        serve_pty(mint_line(), link)
    assert link.read_text() == "mine"


def test_a_link_to_a_line_that_is_served_is_not_taken_over(tmp_path: Path) -> None:
    link = tmp_path / "line"
    with serve_pty(mint_line(), link):
        served = os.readlink(link)
        with pytest.raises(FileExistsError, match=f"another emulator serves it on {served}; end that one, or delete"):
            serve_pty(mint_line(), link)
        assert os.readlink(link) == served
        port = opened(str(link))
        assert ask(port, WRITE, 1) == b"\x06"
        os.close(port)


def test_an_unplugged_pty_is_gone_and_comes_back_at_the_same_path(tmp_path: Path) -> None:
    link = tmp_path / "line"
    line = mint_line()
    first = serve_pty(line, link)
    port = opened(first.path)
    assert ask(port, WRITE, 1) == b"\x06"
    first.close()
    assert os.read(port, 1) == b""
    with pytest.raises(OSError, match="Input/output error"):
        os.write(port, WRITE)
    os.close(port)
    with serve_pty(line, link) as again:
        port = opened(again.path)
        assert ask(port, READ, len(REPLY)) == REPLY
        os.close(port)


def test_a_tcp_port_answers_several_clients_one_after_another() -> None:
    with serve_tcp(mint_line()) as server:
        assert server.path == f"socket://127.0.0.1:{server.port}"
        with connected(server) as client:
            assert ask(client.fileno(), WRITE, 1) == b"\x06"
        with connected(server) as client:
            assert ask(client.fileno(), READ, len(REPLY)) == REPLY


def test_a_closed_tcp_port_can_be_served_again_at_once() -> None:
    with serve_tcp(mint_line(), port=free_port()) as server, connected(server) as client:
        assert ask(client.fileno(), WRITE, 1) == b"\x06"
        server.close()
        assert client.recv(1) == b""
    with serve_tcp(mint_line(), port=server.port) as again, connected(again) as client:
        assert ask(client.fileno(), WRITE, 1) == b"\x06"


@contextmanager
def client_of(server: LineServer) -> Iterator[int]:
    """A descriptor to talk to the line by."""
    if isinstance(server, TcpServer):
        with connected(server) as client:
            yield client.fileno()
    else:
        port = opened(server.path)
        yield port
        os.close(port)


@pytest.mark.parametrize("serve", [serve_pty, serve_tcp])
def test_a_paced_line_takes_its_time_and_not_much_more(serve: Callable[[Line], LineServer]) -> None:
    line = mint_line(paced=True, delay=0.002)
    need = (len(READ) + len(REPLY)) * line.tau + 0.002
    with serve(line) as server, client_of(server) as port:
        ask(port, WRITE, 1)
        for _ in range(1000):  # the quickest of many: what a busy machine adds is not the line's
            start = time.monotonic()
            assert ask(port, READ, len(REPLY)) == REPLY
            took = time.monotonic() - start
            assert took >= need
            if took < need + 0.002:
                return
    pytest.fail(f"not one of 1000 replies came within {need + 0.002} s")


@pytest.mark.parametrize("serve", [serve_pty, serve_tcp])
def test_a_host_that_never_reads_loses_bytes_and_hurts_nobody(serve: Callable[[Line], LineServer]) -> None:
    flood = bytes(50_000_000)
    with serve(mint_line()) as server:
        with client_of(server) as port:
            # It is connected, and no reply is left that the next client would get.
            assert ask(port, WRITE, 1) == b"\x06"
            server.call(lambda line, now: server._deliver(flood))
            assert server.dropped > 0
        with client_of(server) as port:
            if isinstance(server, TcpServer):
                assert ask(port, WRITE, 1) == b"\x06"


def test_a_tcp_client_that_vanishes_leaves_the_port_to_others() -> None:
    with serve_tcp(mint_line()) as server:
        with connected(server) as client:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\0\0\0\0\0\0\0")  # close by a reset
            client.sendall(b"\0")
        with connected(server) as client:
            assert ask(client.fileno(), WRITE, 1) == b"\x06"


def test_an_idle_line_does_not_burn_the_processor() -> None:
    with serve_pty(mint_line(paced=True)) as server:
        assert server._thread.ident is not None
        clock = time.pthread_getcpuclockid(server._thread.ident)
        before = time.clock_gettime(clock)
        time.sleep(0.2)
        assert time.clock_gettime(clock) - before < 0.05


def test_the_thread_of_the_line_can_be_asked_to_change_it() -> None:
    with serve_pty(mint_line()) as server:
        port = opened(server.path)
        server.call(lambda line, now: line.cut(now))
        assert ask(port, WRITE, 1, seconds=0.05) == b""
        server.call(lambda line, now: line.restore(now))
        assert ask(port, WRITE, 1) == b"\x06"
        with pytest.raises(KeyError):
            server.call(lambda line, now: line.device(3))
        os.close(port)
    with pytest.raises(RuntimeError):
        server.call(lambda line, now: None)


def test_a_fault_in_a_device_ends_the_server_and_is_told_at_its_close() -> None:
    class Broken(EmulatedMint):
        def read_element(self, element: int, now: float) -> float:
            raise ZeroDivisionError

    server = serve_tcp(Line(LineSettings(57600), [Broken(2)]))
    with connected(server) as client:
        client.sendall(READ)
        assert client.recv(1) == b""
    server._thread.join(PATIENCE)
    refused: list[str] = []

    def call() -> None:
        try:
            server.call(lambda line, now: None)
        except RuntimeError as error:
            refused.append(str(error))

    caller = threading.Thread(target=call, daemon=True)
    caller.start()
    caller.join(PATIENCE)
    assert refused == [f"{server.path} is no longer served"]
    with pytest.raises(ZeroDivisionError):
        server.close()


def test_every_tcp_client_receives_every_reply() -> None:
    with serve_tcp(mint_line()) as server, connected(server) as one, connected(server) as other:
        for asking, listening in ((one, other), (other, one)):
            assert ask(asking.fileno(), WRITE, 1) == b"\x06"
            assert listening.recv(10) == b"\x06"


def test_a_reply_without_a_client_is_counted_as_dropped() -> None:
    with serve_tcp(mint_line()) as server:
        server.call(lambda line, now: line.send(READ, now))
        until(lambda: server.dropped > 0)
        assert server.dropped == len(REPLY_ZERO)
        with connected(server) as client:
            assert ask(client.fileno(), WRITE, 1) == b"\x06"
        assert server.dropped == len(REPLY_ZERO)


def test_tcp_replies_are_sent_without_delay() -> None:
    with serve_tcp(mint_line()) as server, connected(server) as client:
        assert ask(client.fileno(), WRITE, 1) == b"\x06"
        [accepted] = server._clients.values()
        assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


def test_a_line_is_served_at_an_ipv6_address() -> None:
    with serve_tcp(mint_line(), "::1") as server:
        assert server.path == f"socket://[::1]:{server.port}"
        with connected(server) as client:
            assert ask(client.fileno(), WRITE, 1) == b"\x06"


def descriptors() -> set[str]:
    """What the open descriptors of this process lead to, each with its number."""
    found = set()
    for number in os.listdir("/proc/self/fd"):
        with suppress(OSError):
            found.add(f"{number} {os.readlink(f'/proc/self/fd/{number}')}")
    return found


@pytest.mark.parametrize("serve", [serve_pty, serve_tcp])
def test_a_closed_server_leaves_nothing_open(serve: Callable[[Line], LineServer]) -> None:
    before = descriptors()
    server = serve(mint_line())
    with client_of(server) as client:
        assert ask(client, WRITE, 1) == b"\x06"
        server.close()
    server.close()
    assert descriptors() <= before


def test_a_link_that_cannot_be_made_leaves_nothing_open(tmp_path: Path) -> None:
    (tmp_path / "line").write_text("mine")
    before = descriptors()
    with pytest.raises(FileExistsError):
        serve_pty(mint_line(), tmp_path / "line")
    assert descriptors() <= before


def test_a_link_to_another_device_is_replaced(tmp_path: Path) -> None:
    """Only a pseudo-terminal has an emulator behind it."""
    link = tmp_path / "line"
    link.symlink_to("/dev/null")
    with serve_pty(mint_line(), link):
        assert os.readlink(link).startswith("/dev/pts/")


def test_a_link_that_leads_elsewhere_by_now_is_left_alone(tmp_path: Path) -> None:
    link = tmp_path / "line"
    with serve_pty(mint_line(), link):
        link.unlink()
        link.symlink_to("/dev/null")
    assert os.readlink(link) == "/dev/null"


def test_a_closed_server_refuses_every_call() -> None:
    server = serve_tcp(mint_line())
    server.close()
    with pytest.raises(RuntimeError, match=f"{server.path} is no longer served"):
        server.call(lambda line, now: None)


def test_a_call_that_the_end_of_the_server_overtakes_fails() -> None:
    """It is queued when the thread ends, and must not wait for ever."""
    with serve_tcp(mint_line()) as server:

        def end(line: Line, now: float) -> None:
            server._actions.put((lambda line, now: None, waiting))
            raise SystemExit

        waiting: Future[None] = Future()
        server._actions.put((end, Future()))
        os.write(server._button, b".")
        with pytest.raises(RuntimeError, match="no longer served"):
            waiting.result(PATIENCE)
        with pytest.raises(SystemExit):
            server.close()


def test_another_framing_is_named_in_the_report() -> None:
    reports: list[str] = []
    line = Line(LineSettings(9600, 8, "E"), [EmulatedMint(2)])
    with serve_pty(line, report=reports.append) as server:
        port = opened(server.path)
        settings = termios.tcgetattr(port)
        settings[2] |= termios.PARODD
        settings[4] = settings[5] = termios.B9600
        termios.tcsetattr(port, termios.TCSANOW, settings)
        os.write(port, READ)
        until(lambda: bool(reports))
        os.close(port)
    [report] = reports
    assert report == (
        f"{server.path}: the other side sends with 8O1, but the emulated line has 8E1: neither can read the other. "
        "Set the other side to 8E1, or emulate a line with 8O1"
    )


@pytest.mark.parametrize(
    ("line", "client", "found"),
    [
        ((9600, 8, "N"), (0, 19200, False), (19200, 8, "N")),  # the rates of both directions may differ: it sends
        ((9600, 8, "N"), (19200, 9600, False), None),
        ((9600, 8, "N"), (0, 0, False), None),  # a rate of 0 is a hang-up
        ((9600, 7, "E"), (9600, 9600, False), None),  # a pseudo-terminal has no flag for even parity, nor 7 bits
        ((9600, 7, "E"), (9600, 9600, True), (9600, 7, "O")),
        ((9600, 7, "O"), (9600, 9600, True), None),
        ((9600, 7, "O"), (9600, 9600, False), (9600, 7, "N")),
    ],
)
def test_settings_of_a_client_are_compared_with_those_of_the_line(
    line: tuple[int, int, str], client: tuple[int, int, bool], found: tuple[int, int, str] | None
) -> None:
    incoming, outgoing, odd = client
    words = port_settings.TERMIOS2.pack(0, 0, termios.PARODD * odd, 0, b"", incoming, outgoing)
    port = port_settings.differing(words, LineSettings(*line))
    assert port == (None if found is None else LineSettings(*found))
    assert port_settings.differing(b"", LineSettings(*line)) is None
