"""Glints: detection of bright spots, fits, classification, and assignment to lights."""
