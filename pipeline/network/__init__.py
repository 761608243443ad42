"""What a radio does: packets, reliable transport, signatures, and the model of lossy links."""
