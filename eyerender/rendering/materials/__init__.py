"""Materials: albedo and relief of iris and sclera, and gloss of skin and tear film."""
