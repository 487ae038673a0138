"""Runs that survive a kill: chunk by chunk, with checkpoints from which they go on bit for bit."""
