"""From files as they are distributed to recordings, one MCAP log per robot."""
