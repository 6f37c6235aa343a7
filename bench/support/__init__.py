"""What benchmarks and tests share: synthetic problems with known answers, other implementations, helper processes."""
