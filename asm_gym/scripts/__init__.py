"""Commands: each reads its arguments, calls the rooms below, and prints what came out."""
