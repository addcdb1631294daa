"""Entry of `python -m eyerender`, the same as the console script."""

from .cli import main

main()
