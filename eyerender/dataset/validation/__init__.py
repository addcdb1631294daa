"""The parts of `validate`: checksums of files, lines against shards and plan, recomputed values, masks."""
