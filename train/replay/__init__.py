"""What learners of values remember: a ring of steps, and hindsight experience replay."""
