"""Reading reference recordings: markers and joint angles of other systems."""
