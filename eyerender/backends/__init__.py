"""Backends of the renderer: finding, trying and choosing one, the set-up of libLLVM, and the doctor.

Only this package and `rendering` import Mitsuba and Dr.Jit. `choose.choose_backend` must run first: importing Dr.Jit
loads a libLLVM at once and permanently, and not every libLLVM that loads also works.
"""
