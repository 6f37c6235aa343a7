"""Read, write, validate and degrade captures."""
