"""The `busmaster` program, and everything around a line that a file configures. It is built on the library.

The library does not import it, except for the names that the root imports on demand.
"""
