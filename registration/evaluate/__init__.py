"""Measure registrations: distances from scan and ground truth, penetration of parts."""
