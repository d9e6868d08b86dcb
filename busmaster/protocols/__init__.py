"""The five protocols: each module has its commands, their exchanges and its PROFILE; element maps are data."""
