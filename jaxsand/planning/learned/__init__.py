"""Strokes proposed by a network, and looking ahead with them."""
