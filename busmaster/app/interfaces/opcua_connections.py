"""TCP connections of OPC UA clients, and the server that accepts them."""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from typing import Any

from asyncua import Server, ua
from asyncua.common.utils import Buffer, ServiceError
from asyncua.crypto.uacrypto import check_certificate
from asyncua.server.binary_server_asyncio import BinaryServer, OPCUAProtocol
from asyncua.server.uaprocessor import UaProcessor
from asyncua.ua.ua_binary import header_from_binary, nodeid_from_binary, struct_from_binary

from busmaster.app.bounds import (
    LONGEST_OPCUA_CHUNK,
    LONGEST_OPCUA_HELLO,
    LONGEST_OPCUA_REQUEST,
    LONGEST_SESSION_PAUSE,
    MOST_WAITING_WRITES,
    SESSION_WITHIN,
)
from busmaster.app.interfaces.opcua_terms import CODES

WRITE = ua.NodeId(ua.ObjectIds.WriteRequest_Encoding_DefaultBinary)
CREATE_SESSION = ua.NodeId(ua.ObjectIds.CreateSessionRequest_Encoding_DefaultBinary)
OF_THE_SESSION = (
    CREATE_SESSION,
    ua.NodeId(ua.ObjectIds.ActivateSessionRequest_Encoding_DefaultBinary),
    ua.NodeId(ua.ObjectIds.CloseSessionRequest_Encoding_DefaultBinary),
)
"""Requests that change whose requests are answered: the writes before them end first."""
KINDS = (ua.MessageType.Hello, ua.MessageType.SecureOpen, ua.MessageType.SecureMessage, ua.MessageType.SecureClose)
LEAST_CHUNK = 12
"""Bytes of the header of a chunk. The header of a Hello has 8, and more follows."""
LEAST_BUFFER = 8_192
"""Bytes of a chunk that a client must take, by the standard: of less a reply would be cut into thousands."""
MOST_QUEUED = 50
"""Chunks of one connection that are read and not processed: beyond it nothing more is read."""


class Requests(UaProcessor):  # type: ignore[misc]  # it is untyped
    """Answers the requests of one connection. Writes wait for the line in a task of their own, in their order."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._writes: asyncio.Queue[tuple[Any, Buffer]] = asyncio.Queue()
        self._unanswered = 0
        self._writer: asyncio.Task[None] | None = None
        self._greeted = False

    @property
    def has_session(self) -> bool:
        """Return whether a session is active."""
        return self.session is not None and self.session.is_activated()

    async def process(self, header: Any, body: Any) -> bool:
        """Process one chunk; return False if the connection is to be closed."""
        kind = header.MessageType
        if kind == ua.MessageType.Hello:
            hello = struct_from_binary(ua.Hello, body.copy())
            if self._greeted or min(hello.ReceiveBufferSize, hello.SendBufferSize) < LEAST_BUFFER:
                return False
            self._greeted = True
        elif kind != ua.MessageType.SecureOpen and not self._connection.is_open():
            return False
        goes_on = await super().process(header, body)
        if not self.has_session and self._connection._incoming_size > LONGEST_OPCUA_CHUNK:
            return False  # chunks of a message, of a client without a login
        return bool(goes_on)

    async def process_message(self, seqhdr: Any, body: Any) -> bool:
        """Answer a request; a write is answered when the line has confirmed or refused it."""
        kind = nodeid_from_binary(body.copy())
        if kind == WRITE and self.has_session and self._unanswered < MOST_WAITING_WRITES:
            self._unanswered += 1
            self._writes.put_nowait((seqhdr, body))
            if self._writer is None:
                self._writer = asyncio.create_task(self._write())
            return True
        if kind == WRITE and self.has_session:
            asked, response = body.copy(), ua.ServiceFault()
            nodeid_from_binary(asked)
            response.ResponseHeader.ServiceResult = ua.StatusCode(CODES.BadTooManyOperations)
            self.send_response(struct_from_binary(ua.RequestHeader, asked).RequestHandle, seqhdr, response)
            return True
        if kind in OF_THE_SESSION:
            await self._writes.join()
        if kind == CREATE_SESSION and self.session is not None:
            await self.session.close_session(True)  # the library would leave it behind, with its watchdog
            if self._session_watchdog_task is not None:
                self._session_watchdog_task.cancel()
        return bool(await super().process_message(seqhdr, body))

    async def _write(self) -> None:
        while True:
            seqhdr, body = await self._writes.get()
            try:
                await super().process_message(seqhdr, body)
            except ServiceError as error:
                logging.getLogger("busmaster.opcua").info("a write was not answered: %s", error)
            finally:
                self._unanswered -= 1
                self._writes.task_done()

    async def close(self) -> None:
        """End the session, with its subscriptions and its waiting writes, and the connection."""
        if self._writer is not None:
            self._writer.cancel()
            with suppress(asyncio.CancelledError):
                await self._writer
        self._transport.close()
        await super().close()

    def _should_close_session_on_transport_loss(self) -> bool:
        # The library keeps a session with subscriptions until it times out, for a client that comes back to it. Here
        # none can (`lookup_external_session`): the subscriptions would be served for minutes to a client that is gone.
        return self.session is not None

    def send_response(self, *arguments: Any, **options: Any) -> None:
        """Send a reply, unless the client has gone."""
        if not self._transport.is_closing():
            super().send_response(*arguments, **options)


class ClientConnection(OPCUAProtocol):  # type: ignore[misc]  # it is untyped
    """One connection. It is closed after a message that is too long or out of order, or too long without a session."""

    processor: Requests | None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Serve it, unless there are too many."""
        self._received = bytearray()
        super().connection_made(transport)
        if self.processor is not None:
            self.processor = Requests(self.iserver, transport, self.limits)
            self.processor.set_policies(self.policies)

    def data_received(self, data: bytes) -> None:
        """Take in bytes: a chunk that announces too many is not waited for."""
        # The library collects as many bytes as a client announces, up to 4 GB.
        if self.transport is None or self.transport.is_closing():
            return
        self._received += data
        while len(self._received) >= 8:
            kind, size = bytes(self._received[:3]), int.from_bytes(self._received[4:8], "little")
            most = LONGEST_OPCUA_HELLO if kind == ua.MessageType.Hello else LONGEST_OPCUA_CHUNK
            if kind not in KINDS or not LEAST_CHUNK < size <= most:
                self._refuse(f"a message of {size} bytes, of the kind {kind!r}")
                return
            if len(self._received) < size:
                return
            chunk = Buffer(bytes(self._received[:size]))
            del self._received[:size]
            self.messages.put_nowait((header_from_binary(chunk), chunk))
        if self.messages.qsize() >= MOST_QUEUED:
            self.transport.pause_reading()

    def _refuse(self, what: str) -> None:
        logging.getLogger("busmaster.opcua").info("%s sent %s: closed", self.peer_name, what)
        self._received.clear()
        if self.transport is not None:
            self.transport.abort()

    async def _process_one_msg(self, header: Any, buf: Buffer) -> bool:
        try:
            goes_on = await super()._process_one_msg(header, buf)
        except Exception as error:  # whatever a client sends
            self._refuse(f"an invalid message ({error})")
            return False
        if self.transport is not None and not self.transport.is_closing() and self.messages.empty():
            self.transport.resume_reading()
        return bool(goes_on)

    async def _activation_watchdog(self) -> None:
        # The library looks once after the connection was made: without its session it could stay for ever.
        had_session = True
        while self.processor is not None and self.transport is not None:
            await asyncio.sleep(SESSION_WITHIN)
            if not (had_session or self.processor.has_session):
                self._refuse("no request for a session")
                return
            had_session = self.processor.has_session


class Acceptor(BinaryServer):  # type: ignore[misc]  # it is untyped
    """Accepts connections, from `listen` on; with `start` its port is its own."""

    hostname: str
    port: int

    def _make_protocol(self) -> ClientConnection:
        return ClientConnection(self.iserver, self._policies, self.clients, self.closing_tasks, self.limits)

    async def start(self) -> None:
        """Bind the port. Raises OSError if that is not possible."""
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(self._make_protocol, self.hostname, self.port, start_serving=False)
        self.hostname, self.port = self._server.sockets[0].getsockname()[:2]
        self.cleanup_task = asyncio.create_task(self._close_task_loop())

    async def listen(self) -> None:
        """Begin to accept connections."""
        assert self._server is not None
        await self._server.start_serving()


class OpcuaServer(Server):  # type: ignore[misc]  # it is untyped
    """A server of the library whose connections are `ClientConnection`s. `start` binds its port and does not listen."""

    acceptor: Acceptor

    async def start(self) -> None:
        """Bind the port. Raises OSError if that is not possible."""
        if self.iserver.certificate is not None:
            check_certificate(self.iserver.certificate, self._application_uri)
        await self._setup_server_nodes()
        await self.iserver.start()
        self.limits.max_recv_buffer = LONGEST_OPCUA_CHUNK
        self.limits.max_message_size = LONGEST_OPCUA_REQUEST
        self.limits.max_chunk_count = LONGEST_OPCUA_REQUEST // LEAST_BUFFER + 1
        self.iserver.max_session_timeout_ms = 1000 * LONGEST_SESSION_PAUSE
        self.iserver.max_pending_messages_per_connection = 0  # as many as one read brings: see MOST_QUEUED
        self.bserver = self.acceptor = Acceptor(self.iserver, *self._get_bind_socket_info(), self.limits)
        self.acceptor.set_policies(self._policies)
        try:
            await self.acceptor.start()
        except BaseException:
            await self.iserver.stop()
            raise
