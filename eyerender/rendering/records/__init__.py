"""Device records: the frame, its surfaces and lamps, their upload, and the recording of kernels."""
