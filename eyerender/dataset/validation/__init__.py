"""Parts of `validate`: checksums, metadata against shards and plan, recomputed values, masks."""
