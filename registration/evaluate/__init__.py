"""Evaluate registrations: distances from the scan and the ground truth, and penetration of parts."""
