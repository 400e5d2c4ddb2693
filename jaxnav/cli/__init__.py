"""Command line: one module per command, imported by `jaxnav.__main__` when the command is called."""
