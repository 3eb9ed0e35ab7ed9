"""Neural associative skill memories that watch robots: importing this registers the environments with Gymnasium."""

__version__ = "0.1.0"
