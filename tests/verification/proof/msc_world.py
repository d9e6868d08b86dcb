"""A line of MSCs: an ACK and a packet, the host's ACK, and packets that are said again where that is lost.

A unit is one talker: it takes no request while it says something, and says its packet again until it is acknowledged
or asked anew. Bytes of a packet come one by one, or (for most of its damage) all at once: see `adversary`.
"""

from __future__ import annotations

from typing import Any

from tests.verification.proof.instants import Instant
from tests.verification.proof.wire import Overdue, Ticket, Time, Violation, choose
from tests.verification.proof.world import World

ACK, NAK = b"\x06", b"\x15"
SAID_AGAIN_AFTER = 0.5
SAID_AGAIN_BY = 1.0
"""Seconds from a packet that was not acknowledged to the next time that it is said."""


class MscWorld(World):
    """`Overdue.kind` is "ack", "packet" or "again"; `packet` is what the unit says behind its ACK, or would say
    again."""

    has_one_step = False

    def begin_exchange(self) -> None:
        """What is said is sorted out in `leaves`: the host's ACKs begin nothing."""

    def leaves(self, out: bytes, ticket: Ticket | None, end: Time) -> None:
        """Byte by byte: an ACK or NAK of the host, or a whole request."""
        at = self.now if not isinstance(self.said_by, Instant) else max(self.now, self.said_by)
        said = out
        while out:
            if out[:1] in (ACK, NAK):
                word, out = out[:1], out[1:]
                at = at + self.byte_time
                self._hears_word(word, at)
            else:
                size = 8 + int.from_bytes(out[2:4], "big")
                request, out = out[:size], out[size:]
                at = at + size * self.byte_time
                self._hears_request(request, ticket, at)
        self.said_by = at
        if self.setup.echo:
            self.overdue.append(Overdue(said, at, at + self.setup.late_echo, 0.0, kind="echo"))
        if self.setup.beyond:  # what a network holds may come while the host speaks
            return
        for reply in [
            r for r in self.overdue if r.kind != "echo"
        ]:  # collisions are left out: nobody begins while the host speaks
            if not reply.begun and (not isinstance(reply.lo, Instant) or reply.lo < at + self.byte_time):
                reply.lo = at + self.byte_time

    def _hears_word(self, word: bytes, at: Time) -> None:
        waiting = [reply for reply in self.overdue if reply.kind == "again" and not reply.begun]
        if not waiting:
            return
        if self.losses and choose(2):
            self.losses -= 1
            return
        for reply in waiting:
            self.overdue.remove(reply)
            if word == NAK:
                self.overdue.append(self._packet(reply, at))

    def _hears_request(self, request: bytes, ticket: Ticket | None, at: Time) -> None:
        exchange = self.arbiter._wire.exchange
        resent = getattr(exchange, "_resends", 0) > 0
        if not resent:
            if not self.setup.beyond:
                self._judge_msc()
            self.begin_anew()
            self.losses = self.setup.lost_acknowledgements
        unit = request[1]
        for reply in [r for r in self.overdue if r.kind == "again" and r.unit == unit and not r.begun]:
            if not choose(2):  # else it has not heard the request
                self.overdue.remove(reply)
        if any(reply.unit == unit for reply in self.overdue) and not self.setup.beyond:
            if ticket is not None:
                ticket.undenied -= 1  # it is busy, and takes none
            return
        answers = [self.kind.answer(request, place) for place in range(2)]
        place = choose(2) if ticket is not None and answers[0] != answers[1] else 0
        if ticket is not None:
            ticket.place = place
        edge = self.byte_time if self.setup.assumptions.edge else 0.0
        beyond = self.setup.beyond
        begins = beyond or self.arbiter._step.timing.max_reply_delay
        ack = Overdue(ACK, at + self.byte_time, at + begins + edge, 0.0, kind="ack")
        ack.packet_by = at + (beyond or self.kind.profile.timings.packet.max_reply_delay) + edge
        ack.unit, ack.packet, ack.left, ack.ticket = unit, answers[place], self.setup.retransmissions, ticket
        ack.request = request
        self.overdue.append(ack)

    def _judge_msc(self) -> None:
        """R1, but for packets that are said again: of those R3 alone is asked."""
        for reply in self.overdue:
            if reply.kind != "again" and reply.own and reply.hi > self.now:
                if self.calls is not None:
                    self.calls.append((reply.hi, "may still come until here", reply.data))
                raise Violation(f"R1: an {reply.kind} of an earlier request may still come as the next one leaves")

    def _packet(self, before: Overdue, at: Time, again: bool = False) -> Overdue:
        edge = self.byte_time if self.setup.assumptions.edge else 0.0
        timing = self.kind.profile.timings.packet
        gap = timing.inter_byte_timeout + (self.byte_time if self.setup.assumptions.gap_edge else 0.0)
        if again:
            packet = Overdue(before.packet, at + SAID_AGAIN_AFTER, at + SAID_AGAIN_BY, gap, kind="again")
        else:
            packet = Overdue(before.packet, at + self.byte_time, at + timing.max_reply_delay + edge, gap, kind="packet")
        packet.unit, packet.packet, packet.ticket, packet.own = before.unit, before.packet, before.ticket, before.own
        packet.left = before.left - again
        return packet

    def over(self, reply: Overdue, refused: bool = False, lost: bool = False) -> None:
        """A unit has said all of this: what it says next. Where its ACK is lost, the packet's maximum reply delay
        counts from the request: that is assumed."""
        if reply.kind == "ack":
            if reply.packet and not refused:
                packet = self._packet(reply, self.now)
                if lost or self.setup.beyond:  # all of a reply comes within `beyond`
                    packet.hi = reply.packet_by
                # behind its ACK, where the channel keeps the order of the replies
                self.overdue.insert(0 if self.setup.beyond else len(self.overdue), packet)
        elif reply.left:
            self.overdue.append(self._packet(reply, self.now, again=True))

    def hear_all(self, reply: Overdue, damage: Any) -> None:
        """All the rest of a packet is read at once, as it is or damaged."""
        data = bytearray(reply.data)
        self.overdue.remove(reply)
        if damage is not None:
            place, bit = damage
            if bit is None:
                del data[place]
            else:
                data[place] ^= 1 << bit
        reply.data = b""
        self.over(reply)
        self.hear(bytes(data), reply.origin)

    def is_request(self, out: bytes) -> bool:
        return bool(out.lstrip(ACK + NAK))
