"""Synthetic subjects, their expressions, and captures of them."""
