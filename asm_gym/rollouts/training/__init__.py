"""Train agents with stable-baselines3, from demonstrations and from their own steps."""
