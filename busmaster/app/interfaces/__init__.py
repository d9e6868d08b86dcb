"""Interfaces: programs that show a line to people and plants. Each is a client of its socket, in a process of its
own."""
