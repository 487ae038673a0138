"""How learners are judged: sets of glyphs, how many of them come out right, and environments of known values."""
