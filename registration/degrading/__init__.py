"""Copies of clean captures with realistic errors, to measure robustness."""
