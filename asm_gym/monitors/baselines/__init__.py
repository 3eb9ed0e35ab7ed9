"""Every rival of the Neural ASM."""
