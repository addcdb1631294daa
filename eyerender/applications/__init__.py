"""Applications that compose the package: the quickstart and surveys of populations."""
