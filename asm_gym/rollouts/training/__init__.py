"""What ``asm-gym train`` and ``train-safely`` share: learners, cloning, and runs that go on where they were killed."""
