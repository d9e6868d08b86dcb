"""asyncio meets the arbiter: the pump, and the endpoints that a line can be reached through.

An endpoint is a frozen value that can be opened (`endpoints.Endpoint` is the contract); `reconnect.Connection` keeps
one open. Only this package knows descriptors, sockets and event loops.
"""
