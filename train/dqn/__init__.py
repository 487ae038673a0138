"""Deep Q-learning with hindsight on single strokes over maps: the learner, its networks, targets and tasks."""
