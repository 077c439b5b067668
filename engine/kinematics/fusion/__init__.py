"""One body fitted to the pictures of several cameras at once."""

from engine.kinematics.fusion.fuse import FusedFit, FusionSettings, fuse_views

__all__ = ["FusedFit", "FusionSettings", "fuse_views"]
