"""What a worker runs: register, stabilize, build, evaluate, synthesize."""
