"""Rendering with Mitsuba 3. Call `backends.choose.choose_backend` before importing a module of this package."""
