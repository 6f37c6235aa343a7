"""What workflows keep on disk: subjects, datasets, runs, held-out subjects, the store."""
