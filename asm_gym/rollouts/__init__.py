"""Runs episodes: trials, collections, folders of runs, parallel work."""
