"""Risk methods and flags."""
