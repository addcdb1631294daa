"""Types of the callbacks by which long work reports its progress."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int, str], None]
"""Takes how many pieces of work are done, how many there are in all, and a note (often "")."""
Say = Callable[[str], None]
"""Takes one line of text for the user."""
