"""What the world is, checked: grid, material, walls and edges, tools, windows, and the scene that holds them."""
