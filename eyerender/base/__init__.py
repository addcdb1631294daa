"""Foundations of all packages: errors, array values, specs, storage, progress, processes, compilation, versions."""
