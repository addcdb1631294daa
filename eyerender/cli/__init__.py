"""The command line, `eyerender COMMAND`."""

from .main import main

__all__ = ["main"]
