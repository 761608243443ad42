"""Public pose graphs solved by a team of agents: each robot's own factors, packets over lossy links, nothing else."""
