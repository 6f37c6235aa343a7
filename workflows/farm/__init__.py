"""Flows (the order of jobs), batches, a farm on one machine, debugging of a job."""
