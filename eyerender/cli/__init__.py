"""The command line: `eyerender COMMAND`."""

from .app import main

__all__ = ["main"]
