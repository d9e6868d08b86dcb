"""Connects the arbiter to asyncio: the pump, and the endpoints through which a line is reached.

An endpoint is a frozen value that can be opened (`endpoints.Endpoint` is the contract). `reconnect.Connection` keeps
one open. Only this package uses descriptors, sockets and event loops.
"""
