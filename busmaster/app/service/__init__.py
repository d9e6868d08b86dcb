"""One line for many programs: the process that owns it serves a Unix socket, by which others ask its nodes.

`service.py` listens, `client.py` is one program that has come, `remote.py` is what such a program holds in its hands.
What is said between them is in docs/service.md. The core does not need this room; it needs the extra `service`.
"""
