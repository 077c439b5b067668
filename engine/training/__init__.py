"""How the shipped weights were trained; never imported at run time (extra `train`)."""
