"""Pictures: a strip chart under a frame, films, and recordings for Rerun."""
