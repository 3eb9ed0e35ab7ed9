"""Readers and writers: streams from logs, data sets and sockets, as episodes, and back."""
