"""A network that proposes strokes, and look-ahead with the simulator."""
