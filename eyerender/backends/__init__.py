"""Rendering backends: find, test and choose one, set up libLLVM, and the doctor.

Only this package and `rendering` import Mitsuba and Dr.Jit. `choose.choose_backend` must run first: importing Dr.Jit
loads a libLLVM at once and permanently, and a libLLVM may load without working.
"""
