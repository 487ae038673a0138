"""From a goal to strokes."""
