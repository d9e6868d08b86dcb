"""Damage to a reply on the line: chunks, flipped bits, noise."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, pairwise
from random import Random

FEW_BYTES = 10  # up to this length all splits are tried, 511 at most
MANY_BYTES = 64


def bytewise(data: bytes) -> list[bytes]:
    """Return the data one byte at a time."""
    return [data[i : i + 1] for i in range(len(data))]


def splits(data: bytes) -> Iterator[list[bytes]]:
    """Yield ways to split `data` into chunks: all for a few bytes; else into two, or three if it is not long.

    One of them is one byte at a time.
    """
    length = len(data)
    most = length if length <= FEW_BYTES else 3 if length <= MANY_BYTES else 2
    for count in range(1, most):
        for cuts in combinations(range(1, length), count):
            edges = (0, *cuts, length)
            yield [data[a:b] for a, b in pairwise(edges)]
    if length > FEW_BYTES:
        yield bytewise(data)


def flips(data: bytes, bits: int) -> Iterator[bytes]:
    """Yield `data` with one of the lower `bits` of one byte flipped, for each of them."""
    for position in range(len(data)):
        for bit in range(bits):
            flipped = data[position] ^ 1 << bit
            yield data[:position] + bytes((flipped,)) + data[position + 1 :]


def garbage_chunks(random: Random, reply: bytes) -> Iterator[bytes]:
    """Yield chunks of noise, or of the reply with some of its bytes lost, doubled and overwritten."""
    data = bytearray(reply if random.random() < 0.7 else random.randbytes(random.randrange(300)))
    for _ in range(random.randrange(1, 5)):
        place = random.randrange(len(data) + 1)
        match random.randrange(4):
            case 0:
                del data[place : place + random.randrange(1, 4)]
            case 1:
                data[place:place] = random.randbytes(random.randrange(1, 4))
            case 2:
                data[place : place + 1] = random.randbytes(1)
            case _:
                data += data[place:]
    while data:
        length = random.randrange(1, len(data) + 1)
        yield bytes(data[:length])
        del data[:length]
        if random.random() < 0.2:
            yield b""
