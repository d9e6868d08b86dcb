"""How fast, how steady and how right: `python -m benchmarks`. README.md says how each figure is measured."""
