"""The dashboard: thin pages over the engine."""
