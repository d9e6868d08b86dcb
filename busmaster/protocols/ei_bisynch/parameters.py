"""The mnemonics that both families have, the codes of the last error, and the mnemonics of tags.

Parker SSD, 590 Series and 590+ product manuals and 6513 technical manual HA466357U001, "EI-Bisynch"; Eurotherm, Series
2000 communications handbook HA026230.
"""

from __future__ import annotations

from dataclasses import dataclass

from busmaster.contract.items import Access, Item
from busmaster.errors import InvalidCommand

LAST_ERROR = "EE"
NO_ERROR = 0x00C0
"""Code of Parker SSD. Writing any value to EE sets it."""

DRIVE_ERRORS = {
    NO_ERROR: "no error",
    0x01C7: "the mnemonic does not exist",
    0x02C2: "the checksum (BCC) of the request was wrong",
    0x03C2: "the request had a framing or overrun error",
    0x04C8: "the parameter is write-only",
    0x05C8: "the parameter is read-only",
    0x07C7: "the request had an invalid format",
    0x07C8: "the data had an invalid format",
    0x08C8: "the value is out of range",
}
"""Codes in EE of a Parker SSD drive."""
CONTROLLER_ERRORS = {
    0: "no error",
    1: "the mnemonic does not exist",
    2: "the parameter is read-only",
    7: "the request had an invalid format",
    8: "the value is out of range",
}
"""Codes in EE of a Eurotherm controller."""
ERRORS = CONTROLLER_ERRORS | DRIVE_ERRORS

TAG = "tag"
_TWO_KINDS_FROM, _HIGHEST_TAG = 936, 1611
_SMALL = "0123456789abcdefghijklmnopqrstuvwxyz"


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter that has a name in busmaster. `hexadecimal`: it is written in hexadecimal."""

    name: str
    item: str
    meaning: str
    access: Access = ""
    unit: str = ""
    hexadecimal: bool = False
    kept: str = ""
    """Why a load of parameters never writes it."""

    @property
    def documented(self) -> Item:
        """Its description in the document, for lists."""
        return Item(self.name, self.item, self.meaning, self.unit, self.access)


REACHED_BY = "the drive may be reached by this port: change it at the drive"
MANUAL = Parameter("manual", "mA", "0: automatic, 1: manual")
"""In manual mode the output level can be written."""
PARAMETERS = (
    # of both families
    Parameter("identity", "II", "identity of the instrument, hexadecimal digits on the line", "read"),
    Parameter("software_version", "V0", "version of its software", "read"),
    Parameter(
        "last_error",
        "EE",
        "last error of the communication; writing any value clears it",
        hexadecimal=True,
        kept="it is the last error, which a write clears",
    ),
    # of the 2000 series
    Parameter("process_value", "PV", "process value", "read"),
    Parameter("target_setpoint", "SL", "target setpoint"),
    Parameter("working_setpoint", "SP", "working setpoint", "read"),
    Parameter("output_power", "OP", "output level; writable in manual mode", unit="%"),
    MANUAL,
    Parameter("heater_current", "LI", "heater current, with PDSIO mode 2", "read"),
    Parameter("identification", "ID", "identification number, set by the customer"),
    Parameter("proportional_band", "XP", "proportional band"),
    Parameter("integral_time", "TI", "integral time"),
    Parameter("derivative_time", "TD", "derivative time"),
    Parameter("setpoint_rate", "RR", "rate limit of the setpoint"),
    # of the 590+
    Parameter("port_mode", "tag130", "protocol of the port P3", kept=REACHED_BY),
    Parameter("port_baud_rate", "tag198", "baud rate of the port P3", kept=REACHED_BY),
)
NAMED = {parameter.name: parameter for parameter in PARAMETERS}
ITEMS = (
    *(parameter.documented for parameter in PARAMETERS),
    Item("1PV", "!!-~~", "any mnemonic of the instrument's own list, here of channel 1; without a channel: PV"),
    Item("0PV:hex", ">0000", "the same, written in hexadecimal"),
    Item("tag0-1611", "0-1611", "a parameter of a Parker SSD drive, by its tag number"),
)
"""The meaning of most mnemonics and tags is in the list of each instrument, not in the documents of the protocol."""


def error_text(code: float) -> str:
    """Return the text of a value of EE, with its code in hexadecimal."""
    number = int(code)
    return f">{number:04X}: {ERRORS.get(number, 'a code that the documents do not define')}"


def mnemonic_of_tag(tag: int) -> str:
    """Return the mnemonic of a tag number of a Parker SSD drive. Raises InvalidCommand for a number above 1611."""
    if not 0 <= tag <= _HIGHEST_TAG:
        raise InvalidCommand(f"a tag is a number from 0 to {_HIGHEST_TAG}, not {tag}")
    if tag < _TWO_KINDS_FROM:
        first, second = divmod(tag + 360, 36)
        return _SMALL[first] + _SMALL[second]
    first, second = divmod(tag - _TWO_KINDS_FROM, 26)
    return chr(ord("a") + first) + chr(ord("A") + second)
