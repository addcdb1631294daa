"""What tests share: scenes, jobs, oracles, reference vectors, and processes that stop at a stage of their work.

Pytest puts `tests/` on the path, and mypy reads modules from there, so tests import `support.stages` and the like.
"""
