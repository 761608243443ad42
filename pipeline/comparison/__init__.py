"""What differs between two runs, recordings or logs, or between a run and a golden one."""
