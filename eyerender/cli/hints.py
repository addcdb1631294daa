"""Hints for command lines that cannot be parsed."""

from __future__ import annotations

from difflib import get_close_matches

from cyclopts import CycloptsError, MissingArgumentError, UnknownCommandError, UnusedCliTokensError


def usage_error(error: CycloptsError) -> str:
    """Write one line that states what is wrong with a command line, and what to write instead."""
    command = " ".join(("eyerender", *(error.command_chain or ())))
    spare = [token for token in error.unused_tokens or () if not token.startswith("-")]
    if isinstance(error, UnknownCommandError) and error.unused_tokens:
        return _unknown(error.unused_tokens[0], error, command)
    if isinstance(error, MissingArgumentError) and error.argument is not None and "--output" in error.argument.names:
        where = f"'-o {spare[0]}'" if spare else "'-o DIR'" if error.argument.index is not None else "'-o PATH'"
        return f"--output: missing; write where the result goes as {where} ('{command} --help' shows examples)"
    if isinstance(error, UnusedCliTokensError) and spare:
        return f"{spare[0]}: is one argument too many; outputs are given as -o ('{command} --help' shows examples)"
    text = " ".join(str(error).split()).rstrip(".")
    return f"{text} ('{command} --help' shows examples)"


def _unknown(token: str, error: CycloptsError, command: str) -> str:
    commands = [name for name in error.app or () if not name.startswith("-")]
    near = get_close_matches(token.lower(), commands, n=2)
    instead = f"; did you mean {' or '.join(near)}?" if near else ";"
    return f"Unknown command \"{token}\"{instead} '{command} --help' lists the commands"
