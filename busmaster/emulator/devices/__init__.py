"""The emulated slaves, a module a protocol or a product."""
