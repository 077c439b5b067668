"""The browser front end; thin pages over the engine."""
