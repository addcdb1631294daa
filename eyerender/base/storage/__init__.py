"""Files: durable writes, limited reads, JSON lines, locks, and the private cache folder."""
