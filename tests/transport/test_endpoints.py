"""The URLs that name an endpoint."""

from __future__ import annotations

import pytest

from busmaster.contract.profile import LineSettings
from busmaster.errors import InvalidCommand
from busmaster.transport.endpoints import Endpoint, endpoint
from busmaster.transport.rfc2217 import Rfc2217Port
from busmaster.transport.rs485 import Rs485
from busmaster.transport.serial_port import SerialPort
from busmaster.transport.tcp import TcpPort

MENTOR = LineSettings(9600, 7, "E", 1)


@pytest.mark.parametrize(
    ("url", "port"),
    [
        ("/dev/ttyUSB0?baudrate=57600", SerialPort("/dev/ttyUSB0", baudrate=57600)),
        (
            "/dev/ttyUSB0?baudrate=4800&parity=even&bytesize=7&stopbits=2",
            SerialPort("/dev/ttyUSB0", baudrate=4800, bytesize=7, parity="E", stopbits=2),
        ),
        (
            "/dev/ttyS0?baudrate=9600&rs485=1&echo=true&low_latency=no&receive_latency=0.016&exclusive=off&paced=on",
            SerialPort(
                "/dev/ttyS0",
                baudrate=9600,
                rs485=True,
                echo=True,
                low_latency=False,
                receive_latency=0.016,
                exclusive=False,
                paced=True,
            ),
        ),
        (
            "/dev/ttyS0?baudrate=9600&rs485.level=low&rs485.delay_before=0.001&rs485.delay_after=0.002&rs485.rx_during_tx=1",
            SerialPort(
                "/dev/ttyS0",
                baudrate=9600,
                rs485=Rs485(level="low", delay_before=0.001, delay_after=0.002, rx_during_tx=True),
            ),
        ),
        (
            "usb:A500ABC?baudrate=9600&rs485.by=software&rs485.delay_after=0.0004",
            SerialPort("usb:A500ABC", baudrate=9600, rs485=Rs485(by="software", delay_after=0.0004)),
        ),
        ("usb:A500ABC?baudrate=9600", SerialPort("usb:A500ABC", baudrate=9600)),
        ("usb:12345678:1?baudrate=9600", SerialPort("usb:12345678:1", baudrate=9600)),
        ("usb:12345678?baudrate=9600", SerialPort("usb:12345678", baudrate=9600)),
        ("line?baudrate=9600&rtscts=1&parity=n", SerialPort("line", baudrate=9600, rtscts=True)),
        (
            "line?baudrate=9600&parity=Mark&stopbits=1.5&rtscts=YES",
            SerialPort("line", baudrate=9600, parity="M", stopbits=1.5, rtscts=True),
        ),
        ("line?baudrate=9600&parity=space&echo=False", SerialPort("line", baudrate=9600, parity="S")),
        ("line?baudrate=9600&parity=none&rtscts=off", SerialPort("line", baudrate=9600)),
        ("line?baudrate=9600&rtscts=1&rs485=0", SerialPort("line", baudrate=9600, rtscts=True, rs485=False)),
        ("line?baudrate=9600&parity=odd&rs485=0", SerialPort("line", baudrate=9600, parity="O", rs485=False)),
        ("socket://server:4001", TcpPort("server", 4001)),
        ("socket://[::1]:4001/", TcpPort("::1", 4001)),
        (
            "socket://server:4001?baudrate=9600&receive_latency=0.0033&echo=1&paced=1",
            TcpPort("server", 4001, baudrate=9600, receive_latency=0.0033, echo=True, paced=True),
        ),
        ("rfc2217://server:4001?baudrate=9600", Rfc2217Port("server", 4001, baudrate=9600)),
        (
            "rfc2217://[::1]:4001/?baudrate=9600&bytesize=7&parity=E&stopbits=2&rtscts=1&dtr=0&echo=1&receive_latency=0.01",
            Rfc2217Port(
                "::1",
                4001,
                baudrate=9600,
                bytesize=7,
                parity="E",
                stopbits=2,
                rtscts=True,
                dtr=False,
                echo=True,
                receive_latency=0.01,
            ),
        ),
        (
            "rfc2217://server:4001?baudrate=9600&rts=1&paced=1",
            Rfc2217Port("server", 4001, baudrate=9600, rts=True, paced=True),
        ),
    ],
)
def test_a_url_says_what_the_constructor_says(url: str, port: Endpoint) -> None:
    assert endpoint(url) == port


def test_the_protocol_fills_in_what_the_url_leaves_open() -> None:
    assert endpoint("/dev/ttyUSB0", defaults=MENTOR) == SerialPort(
        "/dev/ttyUSB0", baudrate=9600, bytesize=7, parity="E"
    )
    assert endpoint("/dev/ttyUSB0?parity=O&baudrate=4800", defaults=MENTOR) == SerialPort(
        "/dev/ttyUSB0", baudrate=4800, bytesize=7, parity="O"
    )
    assert endpoint("socket://server:4001", defaults=MENTOR) == TcpPort("server", 4001)
    assert endpoint("rfc2217://server:4001?baudrate=4800", defaults=MENTOR) == Rfc2217Port(
        "server", 4001, baudrate=4800, bytesize=7, parity="E"
    )


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("/dev/ttyUSB0", r"no baud rate given; write for example /dev/ttyUSB0\?baudrate=57600"),
        ("/dev/ttyUSB0?baud=9600", "no such port option 'baud'; did you mean 'baudrate'"),
        ("/dev/ttyUSB0?pairity=E", "did you mean 'parity'"),
        ("/dev/ttyUSB0?zzz=1", "no such port option 'zzz'; there are baudrate, bytesize, parity"),
        ("/dev/ttyUSB0?baudrate=fast", "port option baudrate='fast': use a whole number"),
        ("/dev/ttyUSB0?baudrate=9600&parity=", "port option parity='': use N, E, O, M or S"),
        ("/dev/ttyUSB0?baudrate=9600&echo=maybe", "echo='maybe': use 1 or 0, true or false"),
        ("/dev/ttyUSB0?baudrate=9600&stopbits=3", "stopbits='3': use 1, 1.5 or 2"),
        ("/dev/ttyUSB0?baudrate=9600&receive_latency=16ms", "use a number of seconds, such as 0.016"),
        ("/dev/ttyS0?baudrate=9600&rs485.by=hardware", "option rs485.by='hardware': use driver or software"),
        ("/dev/ttyS0?baudrate=9600&rs485.level=1", "option rs485.level='1': use high or low"),
        ("/dev/ttyS0?baudrate=9600&rs485.delay_before=1ms", "delay_before='1ms': use a number of seconds"),
        ("/dev/ttyS0?baudrate=9600&rs485.delay_after=1", "rs485: delay_after must be 0 to 0.1 s, not 1"),
        ("/dev/ttyS0?baudrate=9600&rs485.delay=1", "no such port option 'rs485.delay'; did you mean 'rs485.delay_"),
        (
            "/dev/ttyS0?baudrate=9600&rs485.level=low&rs485=1",
            "rs485 and rs485.level exclude each other: leave rs485 out",
        ),
        ("/dev/ttyS0?baudrate=9600&rs485.level=low&rtscts=1", "rtscts and rs485 exclude each other"),
        ("?baudrate=9600", "a serial port needs a path"),
        ("usb:?baudrate=9600", "a USB adapter needs a serial number, such as usb:A500ABC"),
        ("socket://server:4001?parity=E", "no such port option 'parity'; there are baudrate, echo"),
        ("socket://server", "'socket://server' is not of the form socket://HOST:PORT"),
        ("socket://:4001", "is not of the form"),
        ("socket://server:port", "is not of the form"),
        ("socket://server:70000", "is not of the form"),
        ("socket://server:4001/dev/ttyS0", "is not of the form"),
        ("socket://[::1:4001", "is not of the form"),
        ("127.0.0.1:4001", "'127.0.0.1:4001' is not a device path; write a TCP port as socket://127.0.0.1:4001"),
        ("tcp://server:4001", "is the address of a running line, .* write a serial server as socket://"),
        ("unix:/run/line.sock", r"unix:/run/line.sock is the address of a running line, .*\. A port is needed here"),
        ("udp://server:4001", "no such kind of port: udp://; use a device path, usb:SERIAL, socket://HOST:PORT or rfc"),
        ("rfc2217://server", "'rfc2217://server' is not of the form rfc2217://HOST:PORT"),
        ("rfc2217://server:4001", r"no baud rate given; write for example rfc2217://server:4001\?baudrate=57600"),
        ("rfc2217://server:4001?baudrate=9600&rs485=1", "no such port option 'rs485'; there are baudrate, bytesize"),
        ("rfc2217://server:4001?baudrate=9600&stopbits=3", "stopbits='3': use 1, 1.5 or 2"),
    ],
)
def test_what_is_not_understood_is_named_with_what_would_do(url: str, says: str) -> None:
    with pytest.raises(InvalidCommand, match=says):
        endpoint(url)


def test_a_port_is_named_by_text() -> None:
    with pytest.raises(InvalidCommand, match="a port must be text"):
        endpoint(None)  # type: ignore[arg-type]  # a caller without a type checker
