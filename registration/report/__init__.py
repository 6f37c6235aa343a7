"""The HTML report of a registration, and snapshots of its stages."""
