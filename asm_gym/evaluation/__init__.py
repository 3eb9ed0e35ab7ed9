"""Evaluation: pure functions over recorded episodes; no simulator, no wrappers."""
