"""The parameters that the Mentor II User Guide describes in its chapter on the serial interface."""

from __future__ import annotations

from dataclasses import dataclass

from busmaster.contract.items import Access, Item


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter: menu, number, and an optional name.

    `decimals`: how many of the last digits on the line are decimals of its unit. `wide`: a 16-bit whole number, sent as
    five digits without a sign.
    """

    menu: int
    number: int
    meaning: str
    name: str = ""
    unit: str = ""
    access: Access = ""
    decimals: int = 0
    wide: bool = False
    kept: str = ""
    """Why a load of parameters never writes it."""

    @property
    def place(self) -> tuple[int, int]:
        """Menu and number."""
        return self.menu, self.number

    @property
    def item(self) -> Item:
        """Its description in the document, for lists."""
        number = f"{self.menu}.{self.number:02d}"
        return Item(self.name or number, number, self.meaning, self.unit, self.access, decimals=self.decimals)


REACHED_BY = "the drive is reached by it: change it at the drive"
SPEED_REFERENCE_1 = Parameter(
    1, 17, "speed reference 1, of the maximum speed", "speed_reference_1", "%", "read/write", decimals=1
)
PARAMETERS = (
    SPEED_REFERENCE_1,
    Parameter(11, 11, "the drive's address on the line, 1 to 99", "serial_address", kept=REACHED_BY),
    Parameter(11, 13, "mode of the serial port; 4 is wide integers", "serial_mode", kept=REACHED_BY),
    *(
        Parameter(menu, number, "a wide integer, 0 to 65535", access="read/write", wide=True)
        for menu, number in ((13, 14), (15, 60), (15, 61), (15, 62), (15, 63))
    ),
)
NAMED = {parameter.name: parameter for parameter in PARAMETERS if parameter.name}
WIDE = frozenset(parameter.place for parameter in PARAMETERS if parameter.wide)
ANY = Item("0-99.0-99", "0.00-99.99", "a parameter, by menu and number: see the drive's own list")
"""For drives of this family: most parameters are not in the documents of the serial interface."""
ITEMS = (*(parameter.item for parameter in PARAMETERS), ANY)
