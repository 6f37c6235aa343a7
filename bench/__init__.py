"""Benchmarks, one module each: `python -m bench.NAME --help`. Their synthetic problems are in `bench.support`."""
