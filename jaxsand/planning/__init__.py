"""Planning: from a goal to the strokes that make it."""
