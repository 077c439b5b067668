"""Results on disk and exports."""
