"""Materials: albedo and relief of iris and sclera, and the gloss of skin and of the tear film."""
