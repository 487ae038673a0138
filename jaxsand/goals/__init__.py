"""Letters, maps and terrains, where they lie, and how near sand comes to them."""
