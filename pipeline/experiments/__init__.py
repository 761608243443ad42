"""Research that no run depends on: other consensus modes, injected faults, references."""
