"""Many captures, many machines: command line, durable steps, flows."""
