"""What renders: finding, trying and choosing a backend, the set-up of libLLVM, and the doctor.

Only this package and `rendering` import Mitsuba and Dr.Jit. `choose.choose_backend` must run before anything else does:
importing Dr.Jit loads a libLLVM at once and for good, and not every libLLVM that loads also works.
"""
