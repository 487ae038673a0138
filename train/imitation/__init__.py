"""Hindsight imitation: what it teaches, on which sand, and the learner whose policy jaxsand ships."""
