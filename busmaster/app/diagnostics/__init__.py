"""Diagnostics of adapters, ports and lines, and the discovery of the nodes on an unknown line."""
