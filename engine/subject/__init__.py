"""Following one person through a video."""
