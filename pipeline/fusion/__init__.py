"""From several robots' evidence to one robot's fused map. Arrays only, no messages."""
