"""The protocols, a folder each. Its `PROTOCOL` describes it to the rest of the package.

A folder contains the codec (commands and their exchanges), the handles, the emulated devices, the reader for captures,
and the maps as data. No code outside names a protocol: see `busmaster.registry`.
"""
