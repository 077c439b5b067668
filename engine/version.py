"""The version of the product and of the parts that decide its numbers."""

from __future__ import annotations

from importlib import metadata

__all__ = ["__version__", "list_versions"]

__version__ = "0.1.0"

_PARTS = ("av", "numpy", "onnxruntime", "opencv-python-headless", "scipy")


def list_versions() -> dict[str, str]:
    """Return the installed versions of the libraries that enter a result."""
    return {name: metadata.version(name) for name in _PARTS}
