"""Rendering with Mitsuba 3."""
