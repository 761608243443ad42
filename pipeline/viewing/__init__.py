"""Views of finished runs: Rerun, and what happened to a round, a packet or a Gaussian."""
