"""Lit, path-traced synthetic photographs of heads."""
