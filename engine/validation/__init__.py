"""Comparison of a result with a marker-based or other reference recording."""
