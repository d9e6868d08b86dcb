"""One line for many programs: the process that owns it serves a Unix socket, through which others use its nodes.

`service.py` listens, `client.py` is one connected program, `remote.py` is the bus in such a program. docs/service.md
describes the messages. The core does not need this package; it needs the extra `service`.
"""
