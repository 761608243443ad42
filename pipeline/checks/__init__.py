"""Whether a recording is sound, before a run spends its time on it."""
