"""File layouts and image sources that several datasets share."""
