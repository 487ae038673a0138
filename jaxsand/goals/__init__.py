"""Goals: letters, maps and terrains, where they lie on the sand, and how near a result comes to them."""
