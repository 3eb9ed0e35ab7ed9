"""From prediction errors to evidence, and from evidence to an alarm."""
