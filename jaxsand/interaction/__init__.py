"""Tools move sand: act, step, follow, rollout, and how a blade or a wheel does it."""
