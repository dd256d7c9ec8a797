"""The step as machine code: memory blocks, schedule, threads, and derivatives."""
