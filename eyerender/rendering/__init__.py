"""Rendering with Mitsuba 3: the only room that imports it.

Nothing here imports mitsuba by itself. `backend.choose_backend` must run first: importing mitsuba makes Dr.Jit load a
libLLVM at once and for good, and not every libLLVM that loads also works.
"""
