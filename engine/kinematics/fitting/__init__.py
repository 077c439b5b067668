"""One file per solver that turns keypoints into joint angles."""
