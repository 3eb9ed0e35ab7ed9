"""Run episodes: trials, collections, folders of runs, parallel work."""
