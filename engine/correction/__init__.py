"""Cleaning keypoint tracks."""
