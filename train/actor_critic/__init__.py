"""An actor-critic for strokes: off-policy with hindsight, a critic that looks along strokes, improvement by samples."""
