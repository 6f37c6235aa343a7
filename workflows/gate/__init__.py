"""The quality gate: which registrations of a run may enter a model, by stated rules and a log of persons' decisions."""
