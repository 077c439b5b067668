"""Camera files: reading other programs' calibrations, reading and writing our own."""

from engine.cameras.files.own import format_calibration
from engine.cameras.files.reading import adapt_to_pictures, match_cameras, read_calibration

__all__ = ["adapt_to_pictures", "format_calibration", "match_cameras", "read_calibration"]
