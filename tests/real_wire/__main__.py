"""Real processes on real ports that stand still: `python -m tests.real_wire --standstills 20`.

A master, its slaves and the network between them are processes of their own on a saturated line of equal reads, and
one of them, or what the driver holds, stands still again and again, for 5 ms to 2 s. Exit status 1 if a value was
wrong or a write was confirmed that nobody carried out.
"""

from __future__ import annotations

import argparse
import sys

from tests.real_wire.kinds import KINDS
from tests.real_wire.trial import PORTS, Verdict, trial

COLUMNS = ("standstills", "values", "wrong", "written", "falsely", "failed", "back", "longest", "later")


def main() -> int:
    arguments = _parse()
    _say(f"{'':8}{'':8}{'':10}{''.join(column.rjust(12) for column in COLUMNS)}")
    bad = 0
    for protocol in arguments.protocol:
        for port in arguments.port:
            for what in PORTS[port]:
                if arguments.what and what not in arguments.what:
                    continue
                try:
                    verdict = trial(protocol, port, what, arguments.standstills, arguments.longest, arguments.seed)
                except AssertionError as error:
                    _say(f"{protocol:8}{port:8}{what:10}  {error}")
                    bad += 1
                    continue
                _report(protocol, port, what, verdict)
                bad += len(verdict.wrong) + len(verdict.falsely_confirmed)
    return 1 if bad else 0


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.real_wire", description=__doc__)
    parser.add_argument("--standstills", type=int, default=20, metavar="N", help="of each trial")
    parser.add_argument("--longest", type=float, default=2.0, metavar="S", help="seconds that one lasts at the most")
    parser.add_argument("--seed", type=int, default=1, metavar="N")
    parser.add_argument("--protocol", action="append", choices=list(KINDS), help="again for several; all by default")
    parser.add_argument("--port", action="append", choices=list(PORTS), help="again for several")
    parser.add_argument("--what", action="append", help="only this stands still; again for several")
    arguments = parser.parse_args()
    arguments.protocol = arguments.protocol or list(KINDS)
    arguments.port = arguments.port or list(PORTS)
    return arguments


def _report(protocol: str, port: str, what: str, verdict: Verdict) -> None:
    """`back`, `longest`: seconds until all nodes gave good values again after standstills of up to a second, the
    median and the longest; `later`: the longest after longer ones."""
    back = sorted(verdict.back)
    median = back[len(back) // 2] if back else 0.0
    counts = (
        *(len(verdict.standstills), verdict.values, len(verdict.wrong), verdict.written),
        *(len(verdict.falsely_confirmed), verdict.failed, f"{median:.3f}", f"{verdict.longest_back:.3f}"),
        f"{max(verdict.back_later, default=0.0):.3f}",
    )
    _say(f"{protocol:8}{port:8}{what:10}{''.join(str(count).rjust(12) for count in counts)}")
    for what_happened in (*verdict.wrong[:1], *verdict.falsely_confirmed[:1]):
        _say(f"    {what_happened}")


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
