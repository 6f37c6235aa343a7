"""Checks of captures before anything is computed: what is wrong, and what mends it."""
