"""The equations of ``asm_gym.detection.glitches`` in NumPy: an oracle of the compiled rows."""

from __future__ import annotations

import numpy as np

from asm_gym.detection.glitches import LARGEST_SPIKE, QUIET, SPIKE, TRACE, Waiting


def held_back(rule, before, whitened):
    """Errors (B, X) without spikes; what is let go (B, X) and how many rows late (B,); and what waits next."""
    errors = whitened.copy()
    late = np.zeros(len(errors), int)
    after = Waiting.start(*errors.shape)
    for n, error in enumerate(errors):
        size = np.abs(error) / rule.usual
        group = rule.groups[size.argmax()]
        others = size[rule.groups != group]
        left = before.left[n]
        if left and size.max() > TRACE:
            late[n] = rule.rows - left + 1
            left = 0
        after.left[n] = max(left - 1, 0)
        if after.left[n]:
            after.rest[n] = before.rest[n]
        after.unusual[n] = rule.rows if size.max() > QUIET else max(before.unusual[n] - 1, 0)
        seen_elsewhere = before.unusual[n] or (others > QUIET).any()
        if SPIKE < size.max() <= LARGEST_SPIKE and not seen_elsewhere:
            after.left[n] = rule.rows
            limit = np.where(rule.groups == group, rule.usual, np.inf)
            limited = np.clip(error, -limit, limit)
            after.rest[n] = error - limited
            errors[n] = limited
    return errors, late, after


def followed(evidence, errors, late, gains):
    """The vector (B, G, X) of evidence after errors (B, X), with what is let go so many rows (B,) late."""
    gain = gains[:, None]
    vector = evidence.vector + gain * (errors[:, None] - evidence.vector)
    rest = np.where(late[:, None] > 0, evidence.waiting.rest, 0.0)
    return vector + gain * (1.0 - gain) ** late[:, None, None] * rest[:, None]
