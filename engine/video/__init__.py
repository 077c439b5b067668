"""Video in and out: reading, writing, overlay, privacy."""
