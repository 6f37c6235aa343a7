"""Landmarks detected in photographs: providers, views, and agreement across views."""
