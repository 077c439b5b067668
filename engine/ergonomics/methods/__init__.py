"""One file per risk method."""
