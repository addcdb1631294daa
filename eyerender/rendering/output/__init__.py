"""Rendering results: windows with their image and glints, labels, and exported scenes."""
