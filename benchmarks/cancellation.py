"""Callers that give up: does the next one get their value?

Four callers read registers of two units, and about half of the reads are cancelled, queued or on the wire: what
`asyncio.timeout`, a closed web page or a task group do all day. Units answer after 1 to 8 ms.
"""

from __future__ import annotations

from benchmarks.harness import Options, Outcome
from benchmarks.trials import compare

DELAY = {"low": 0.001, "high": 0.008}
PATIENCE = 0.05
TITLE = "Reads that are cancelled after 0 to 50 ms"


def run(options: Options) -> Outcome:
    return compare(TITLE, "cancelled callers", DELAY, PATIENCE, options)
