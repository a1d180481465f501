"""The manual: pages that a browser shows from a folder, without a network."""

from .site import build

__all__ = ["build"]
