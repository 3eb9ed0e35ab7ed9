"""The guard's engine: from rows of n streams to who acts next, without an environment and without a simulator."""
