"""Which dialect a protocol's name means, and which protocol a request's bytes speak."""

from __future__ import annotations

from collections.abc import Callable

from busmaster.capture.decode import Dialect
from busmaster.capture.packets import Dc104Dialect, MscDialect
from busmaster.capture.telegrams import Hcp2Dialect, HcpDialect, MentorDialect
from busmaster.errors import InvalidCommand

_STX, _EOT, _BEL = 0x02, 0x04, 0x07
_DC104_READ, _DC104_WRITE = 0xAA, 0x55

DIALECTS: dict[str, Callable[[], Dialect]] = {
    "hcp": HcpDialect,
    "hcp2": Hcp2Dialect,
    "microflex": Hcp2Dialect,
    "msc": MscDialect,
    "mentor": MentorDialect,
    "dc104": Dc104Dialect,
}


def dialect(protocol: str) -> Dialect:
    """A fresh dialect. Raises InvalidCommand for a name that is no protocol's."""
    try:
        return DIALECTS[protocol]()
    except KeyError:
        raise InvalidCommand(f"no such protocol {protocol!r}: use {', '.join(DIALECTS)}") from None


def protocol_of(request: bytes) -> str:
    """The protocol of a request of a master's, or "" for an acknowledgement or a short command, which all share."""
    if len(request) < 4:
        return ""
    if request[0] == _STX:
        return "dc104" if request[1] in (_DC104_READ, _DC104_WRITE) else "msc"
    if request[0] == _EOT:
        return "hcp" if request[3] == _STX else "mentor"
    return "hcp2" if request[0] == _BEL else ""
