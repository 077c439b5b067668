"""Running assessments in worker processes."""
