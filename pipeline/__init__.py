"""The stages of a run, the mathematics below them, and the readers of what they leave."""
