"""TCP connections of OPC UA clients, and the server that accepts them."""

from __future__ import annotations

import asyncio
from typing import Any

from asyncua import Server
from asyncua.crypto.uacrypto import check_certificate
from asyncua.server.binary_server_asyncio import BinaryServer, OPCUAProtocol
from asyncua.server.uaprocessor import UaProcessor


class Requests(UaProcessor):  # type: ignore[misc]  # it is untyped
    """Answers the requests of one connection."""

    def _should_close_session_on_transport_loss(self) -> bool:
        # The library keeps a session with subscriptions until it times out, for a client that comes back to it. Here
        # none can (`lookup_external_session`): the subscriptions would be served for minutes to a client that is gone.
        return self.session is not None

    def send_response(self, *arguments: Any, **options: Any) -> None:
        """Send a reply, unless the client has gone."""
        if not self._transport.is_closing():
            super().send_response(*arguments, **options)


class ClientConnection(OPCUAProtocol):  # type: ignore[misc]  # it is untyped
    """One connection."""

    processor: Requests | None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Serve it, unless there are too many."""
        super().connection_made(transport)
        if self.processor is not None:
            self.processor = Requests(self.iserver, transport, self.limits)
            self.processor.set_policies(self.policies)


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
        self.bserver = self.acceptor = Acceptor(self.iserver, *self._get_bind_socket_info(), self.limits)
        self.acceptor.set_policies(self._policies)
        try:
            await self.acceptor.start()
        except BaseException:
            await self.iserver.stop()
            raise
