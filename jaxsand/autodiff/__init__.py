"""Bounded loops with derivatives in forward and reverse mode, alone and in batches."""
