"""The macroprogram status word of an MSC (IB-11A002, "Macroprogram Status Word")."""

from __future__ import annotations

import enum

from busmaster.contract.items import bits_of


class ProgramStatus(enum.IntFlag):
    """The macroprogram status word. `errors` and `warnings` return bits that show a fault, `texts` their meanings.

    The errors are those of the document. The warnings are further bits that need attention.
    """

    PROGRAM_RUNNING = 1
    BATTERY_LOW = 2
    RAM_NOT_RELIABLE = 4
    SYSTEM_RESET = 8
    RETURN_INTERRUPT = 16
    FAULT_INTERRUPT = 32
    AUTO_START_ENABLED = 64
    SYSTEM_TEST = 128
    LOAD_OVER_RUNNING_PROGRAM = 256
    CHECKSUM_INCORRECT = 512
    LOAD_IN_PROGRESS = 1024
    LOAD_OUT_OF_SEQUENCE = 2048
    BAD_OPCODE = 4096
    STACK_OVERFLOW = 8192
    STACK_UNDERFLOW = 16384
    INTERRUPT_TABLE_FULL = 32768

    @property
    def errors(self) -> ProgramStatus:
        """The bits that are errors according to the document."""
        return self & ERRORS

    @property
    def warnings(self) -> ProgramStatus:
        """The bits that are not errors, but need attention."""
        return self & WARNINGS

    @property
    def texts(self) -> tuple[str, ...]:
        """The meaning of each bit that is set, the lowest first."""
        return tuple(bit.meaning for bit in STATUS_BITS if self >> bit.number & 1)


ERRORS = (
    ProgramStatus.LOAD_OVER_RUNNING_PROGRAM
    | ProgramStatus.CHECKSUM_INCORRECT
    | ProgramStatus.LOAD_OUT_OF_SEQUENCE
    | ProgramStatus.BAD_OPCODE
    | ProgramStatus.STACK_OVERFLOW
    | ProgramStatus.STACK_UNDERFLOW
    | ProgramStatus.INTERRUPT_TABLE_FULL
)
WARNINGS = (
    ProgramStatus.BATTERY_LOW
    | ProgramStatus.RAM_NOT_RELIABLE
    | ProgramStatus.SYSTEM_RESET
    | ProgramStatus.FAULT_INTERRUPT
)
STATUS_BITS = bits_of(
    {
        ProgramStatus.PROGRAM_RUNNING: "the program runs",
        ProgramStatus.BATTERY_LOW: "the battery of the memory is low",
        ProgramStatus.RAM_NOT_RELIABLE: "the RAM is not reliable",
        ProgramStatus.SYSTEM_RESET: "the system was reset, which cleared the program",
        ProgramStatus.RETURN_INTERRUPT: "a system return interrupt has occurred",
        ProgramStatus.FAULT_INTERRUPT: "a system fault interrupt has occurred",
        ProgramStatus.AUTO_START_ENABLED: "the program starts on power-up",
        ProgramStatus.SYSTEM_TEST: "a system test is in progress",
        ProgramStatus.LOAD_OVER_RUNNING_PROGRAM: "a program was loaded over one that ran",
        ProgramStatus.CHECKSUM_INCORRECT: "the checksum is incorrect",
        ProgramStatus.LOAD_IN_PROGRESS: "a program is being loaded",
        ProgramStatus.LOAD_OUT_OF_SEQUENCE: "a program was loaded out of sequence",
        ProgramStatus.BAD_OPCODE: "a bad opcode was found",
        ProgramStatus.STACK_OVERFLOW: "the stack has overflowed",
        ProgramStatus.STACK_UNDERFLOW: "the stack has underflowed",
        ProgramStatus.INTERRUPT_TABLE_FULL: "the table of software interrupts is full",
    },
    errors=ERRORS,
    warnings=WARNINGS,
)
