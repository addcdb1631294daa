"""Glints: detection of bright spots, their fits, the decision which are glints, and matching them to the lights."""
