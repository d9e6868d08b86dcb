"""Clients of Modbus TCP by two libraries: `python -m tests.verification.modbus_clients.clients NAME PORT STEPS.json`.

Each step of the file is `["read", unit, first, count]` or `["write", unit, first, value]`, of holding registers. A
client makes one request after the other, and prints each reply as JSON: `seconds`, `code` (the exception, 0 for none,
-1 if there was no reply) and `values`. client.js is the same for modbus-serial.
"""

from __future__ import annotations

import ctypes
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pymodbus.client import ModbusTcpClient

LIBRARY = "libmodbus.so.5"
FIRST_ERROR = 112345678
"""Errors of libmodbus are exception codes above this number."""
WITHIN = 20

Request = Callable[[str, int, int, int], tuple[int, list[int]]]
"""Makes a request, and returns code and values of the reply."""


def pymodbus(port: int) -> Request:
    """Return what makes requests by pymodbus."""
    client: Any = ModbusTcpClient("127.0.0.1", port=port, timeout=WITHIN, retries=0)
    assert client.connect()

    def request(kind: str, unit: int, first: int, what: int) -> tuple[int, list[int]]:
        if kind == "read":
            reply = client.read_holding_registers(first, count=what, device_id=unit)
        else:
            reply = client.write_register(first, what, device_id=unit)
        return (int(reply.exception_code), []) if reply.isError() else (0, list(reply.registers))

    return request


def libmodbus(port: int) -> Request:
    """Return what makes requests by libmodbus."""
    library = ctypes.CDLL(LIBRARY, use_errno=True)
    library.modbus_new_tcp.restype = ctypes.c_void_p
    connection = ctypes.c_void_p(library.modbus_new_tcp(b"127.0.0.1", port))
    library.modbus_set_response_timeout(connection, WITHIN, 0)
    assert library.modbus_connect(connection) == 0
    registers = (ctypes.c_uint16 * 125)()

    def request(kind: str, unit: int, first: int, what: int) -> tuple[int, list[int]]:
        library.modbus_set_slave(connection, unit)
        if kind == "read":
            count = library.modbus_read_registers(connection, first, what, registers)
        else:
            count = library.modbus_write_register(connection, first, ctypes.c_uint16(what))
        if count < 0:
            error = ctypes.get_errno() - FIRST_ERROR
            return (error if 0 < error < 20 else -1), []
        return 0, registers[:count] if kind == "read" else []

    return request


def main() -> None:
    name, port, steps = sys.argv[1:]
    request = {"pymodbus": pymodbus, "libmodbus": libmodbus}[name](int(port))
    for step in json.loads(Path(steps).read_text()):
        began = time.monotonic()
        code, values = request(*step)
        sys.stdout.write(json.dumps({"seconds": time.monotonic() - began, "code": code, "values": values}) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
