"""Many runs at once: recordings, configurations and seeds, on one machine or several."""
