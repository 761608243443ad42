"""The front end: tracks one robot's RGB-D camera and grows its Gaussian map from its own log alone."""
