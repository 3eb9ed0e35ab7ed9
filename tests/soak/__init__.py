"""What a minute of tests cannot show: thousands of hostile calls, kills at random moments, long guarded runs.

python -m tests.soak --cases 3000 --kills 100 --steps 1000000 --out runs/soak          or  make soak
"""
