"""Camera trajectories of a team through free space, with a given overlap of views."""
