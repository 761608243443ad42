"""Fisher information of a robot's own map: how well its own images fix each Gaussian."""
