"""Rendering backends: find, test and choose one, set up libLLVM, and the doctor.

Only this package and `rendering` import Mitsuba and Dr.Jit. Importing Dr.Jit loads a libLLVM at once and permanently,
and a libLLVM may load without working, so `hook` chooses one before any import of Dr.Jit.
"""
