"""The protocols, a folder each: `PROTOCOL` in it says all that the rest of the package knows of it.

In a folder are its codec (commands and their exchanges), its handles, its emulated devices, its reader of captures,
and its maps as data. Nothing outside names a protocol: see `busmaster.registry`.
"""
