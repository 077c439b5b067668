"""Video of a person lifting becomes posture, joint angles and a lifting-risk assessment."""
