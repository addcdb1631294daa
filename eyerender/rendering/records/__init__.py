"""Device records: the frame, its surfaces and lamps, their upload, and recorded kernels."""
