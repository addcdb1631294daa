"""Rendering with Mitsuba 3. `backends.choose.choose_backend` must run before a module of this package is imported."""
