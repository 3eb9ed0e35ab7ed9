"""What every command answers with a line and exit code 2, rather than a traceback."""

from __future__ import annotations

import gymnasium as gym

USAGE_ERRORS = (ValueError, TypeError, OSError, ImportError, gym.error.Error)
"""Raised where arguments, files or what is installed make no sense; no cluster at an address is an OSError too."""
