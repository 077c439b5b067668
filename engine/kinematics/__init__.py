"""Joint angles, events and lifts."""
