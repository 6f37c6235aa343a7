"""Cameras from photographs alone: poses and focal lengths, metric by the head model."""
