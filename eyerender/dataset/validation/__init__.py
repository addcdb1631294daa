"""The parts of `validate`: files against checksums, lines against shards and plan, values recomputed, masks."""
